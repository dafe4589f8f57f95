"""The pre-flight: what must hold before a run's first measurement. Each check has number, limit, verdict, remedy.

The loop knows no physics, so the panel is asked with plain levels: a random pattern spreads the light over every
direction, level 0 everywhere leaves it in one; a camera that cannot tell the two apart looks at something else.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import RefusedError, SafetyStop
from holocal.loop import gates
from holocal.loop.devices import Frame
from holocal.loop.procedure import Plan, Shot
from holocal.loop.shooting import Shooter
from holocal.records.facts import RigFacts

RECORD_BYTES = 64 * 2**20  # maps, report, checkpoints
OFFSET_LIMIT = 0.25  # of full scale: a dark frame above it means ambient light or a wrong black level
NOISE_LIMIT = 0.05  # of full scale
HOT_LIMIT = 1e-3  # share of pixels
HOT_LEVEL = 0.5  # of full scale: fainter ones are taken off with the dark frame
MOVED_LIMIT = 3.0  # change of the picture over its noise
LEVEL_WANTED = (0.1, 0.9)  # 99.9th percentile of the pattern's picture, of full scale
MOST_EXPOSURES = 6


@dataclass(frozen=True)
class Check:
    """One line of the pre-flight: `verdict` is "pass" or "fail"; `remedy` says what to do when it fails."""

    id: str
    title: str
    measured: float | str
    limit: float | str
    unit: str
    verdict: str
    remedy: str

    def as_json(self) -> dict[str, Any]:
        """Return the check as a JSON-ready dictionary."""
        return asdict(self)


def check(
    identifier: str, title: str, measured: float, limit: float, unit: str, remedy: str, *, at_least: bool = False
) -> Check:
    """Return a check that passes when `measured` is at most (or `at_least`) `limit`."""
    passed = measured >= limit if at_least else measured <= limit
    return Check(identifier, title, measured, limit, unit, "pass" if passed else "fail", remedy)


def preflight(shooter: Shooter, facts: RigFacts, plan: Plan | None, directory: Path) -> list[Check]:
    """Return the checks of a rig in the order they are made: those without light first, and only those when one fails.

    Raises
    ------
    SafetyStop
        The picture clips at the camera's shortest exposure.
    """
    longest_s = facts.camera.exposure_max_s if plan is None else plan.exposure_ceiling_s
    # Between the shortest and the longest: at the longest, dark current alone may fill the well of a warm camera.
    usual_s = float(np.sqrt(facts.camera.exposure_min_s * longest_s))
    checks = [disk_room(directory, facts, plan)]
    dark = shooter.grab(_shot("pre-flight dark", None, usual_s, facts))
    checks += dark_checks(dark, facts)
    if any(item.verdict == "fail" for item in checks):
        return checks  # refused before the light goes on
    lit = _lit_frame(shooter, facts, dark)
    checks += [format_check(lit, facts), low_bits_check(lit), clipping_check(lit)]
    panel = np.zeros((facts.slm.height, facts.slm.width), np.uint8)
    blanks = [shooter.grab(_shot("pre-flight blank", panel, lit.exposure_s, facts)) for _ in range(2)]
    checks.append(moves_light(lit, blanks[0], blanks[1]))
    checks.append(fresh_frames(dark, lit, *blanks))
    return checks


def refuse_failed(checks: list[Check]) -> None:
    """Raise `RefusedError` that names every failed check; do nothing when all passed."""
    failed = [item for item in checks if item.verdict == "fail"]
    if not failed:
        return
    named = "; ".join(f"{item.id} {item.title}: {_number(item)}" for item in failed)
    raise RefusedError(
        f"pre-flight: {len(failed)} of {len(checks)} checks failed. {named}.",
        why="What is measured on such a bench is not a calibration.",
        fix=" ".join(item.remedy for item in failed),
        measured={item.id: item.measured for item in failed},
        limit={item.id: item.limit for item in failed},
        code=failed[0].id,
    )


def disk_room(directory: Path, facts: RigFacts, plan: Plan | None) -> Check:
    """Return whether the run's files fit on its disk."""
    frames = 10 + (plan.frames if plan is not None else 0)
    needed = RECORD_BYTES + 2 * frames * facts.camera.width * facts.camera.height
    free = shutil.disk_usage(directory).free
    return check(
        "P02",
        "free disk space",
        round(free / 2**20),
        round(needed / 2**20),
        "MiB",
        f"Free space on the disk of {directory}, or choose another with --runs.",
        at_least=True,
    )


def dark_checks(dark: Frame, facts: RigFacts) -> list[Check]:
    """Return offset, noise and hot pixels of a frame taken without light."""
    counts = np.asarray(dark.counts, np.float64)
    offset = float(np.median(counts))
    noise = float(1.4826 * np.median(np.abs(counts - offset)))  # of a normal distribution, hot pixels aside
    hot = counts > offset + max(10.0 * noise, HOT_LEVEL * facts.camera.full_scale)
    scale = facts.camera.full_scale
    return [
        check("P06a", "dark offset", offset / scale, OFFSET_LIMIT, "of full scale", "Shut out ambient light."),
        check("P06b", "dark noise", noise / scale, NOISE_LIMIT, "of full scale", "Lower the camera's gain or cool it."),
        check("P06c", "hot pixels", float(hot.mean()), HOT_LIMIT, "of pixels", "Shut out light, or cool the camera."),
    ]


def format_check(lit: Frame, facts: RigFacts) -> Check:
    """Return whether counts stay within the camera's full scale."""
    found = gates.beyond_full_scale(lit, facts.camera)
    return check("P07a", "highest count", found.measured, found.limit, "counts", found.fix)


def low_bits_check(lit: Frame) -> Check:
    """Return whether the counts' low bits are used."""
    found = gates.low_bits_zero(lit)
    return check("P07b", "low bits that are always 0", found.measured, found.limit, "bits", found.fix)


def clipping_check(lit: Frame) -> Check:
    """Return whether an exposure was found at which the picture does not clip."""
    found = gates.clipped(lit, limit=1e-3)
    return check("P09", "clipped pixels", found.measured, found.limit, "of pixels", "Lower the light by hand.")


def moves_light(lit: Frame, blank: Frame, blank_again: Frame) -> Check:
    """Return whether the panel's pattern changes the picture by more than its noise."""
    first, again, pattern = (np.asarray(frame.counts, np.float64) for frame in (blank, blank_again, lit))
    noise = max(_core_rms(again - first), 0.5)  # half a count: a noiseless camera still rounds
    return check(
        "P10",
        "the panel moves the light: change over noise",
        round(float(np.sqrt(np.mean((pattern - first) ** 2))) / noise, 2),
        MOVED_LIMIT,
        "",
        "Check that the panel is on, gets this computer's output, and that the light is on and not blocked.",
        at_least=True,
    )


def fresh_frames(*frames: Frame) -> Check:
    """Return whether every frame has a number above the one before, and arrived whole."""
    stale = sum(later.frame_id <= earlier.frame_id for earlier, later in pairwise(frames))
    bad = stale + sum(frame.lost_packets > 0 for frame in frames)
    return check("P11", "stale or incomplete frames", float(bad), 0.0, "frames", "Check the camera's trigger and link.")


def _core_rms(difference: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(difference**2)))


def _lit_frame(shooter: Shooter, facts: RigFacts, dark: Frame) -> Frame:
    """Return a frame of the random pattern at an exposure that neither clips nor drowns in noise."""
    camera, panel = facts.camera, facts.slm
    levels = np.random.default_rng(0).integers(0, 2**panel.bits, (panel.height, panel.width), np.uint8)
    exposure_s = float(np.sqrt(camera.exposure_min_s * camera.exposure_max_s))
    offset = float(np.median(dark.counts))
    for _ in range(MOST_EXPOSURES):
        frame = shooter.grab(_shot("pre-flight pattern", levels, exposure_s, facts))
        level = (float(np.percentile(frame.counts, 99.9)) - offset) / camera.full_scale
        if LEVEL_WANTED[0] <= level <= LEVEL_WANTED[1]:
            return frame
        factor = 0.1 if level > LEVEL_WANTED[1] else min(30.0, 0.5 / max(level, 1e-3))
        wanted_s = min(max(frame.exposure_s * factor, camera.exposure_min_s), camera.exposure_max_s)
        if wanted_s == exposure_s:
            break
        exposure_s = wanted_s
    clipped = gates.clipped(frame, limit=0.01)
    if not clipped.ok and frame.exposure_s <= camera.exposure_min_s * (1 + 1e-6):
        raise SafetyStop(
            f"the camera saturates at its shortest exposure: {clipped.sentence}",
            why="Clipped light is not measured, and may harm the sensor.",
            fix="Put a neutral density filter in the beam or lower the laser's power by hand.",
            measured=clipped.measured,
            limit=clipped.limit,
            code="too-bright",
        )
    return frame


def _shot(label: str, levels: NDArray[np.uint8] | None, exposure_s: float, facts: RigFacts) -> Shot:
    middle = facts.wavelengths_m[len(facts.wavelengths_m) // 2]
    return Shot(label=label, levels=levels, exposure_s=exposure_s, wavelength_m=middle)


def _number(item: Check) -> str:
    return f"{item.measured:.4g} against a limit of {item.limit:.4g} {item.unit}".rstrip()
