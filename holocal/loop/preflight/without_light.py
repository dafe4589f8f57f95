"""The checks that need no light: lock, disk, identity, output, read-back, dark frames, age of the calibration."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame, Inspectable, Rig
from holocal.loop.preflight.checks import FAIL, PASS, WARN, Check, check, from_finding, unknown
from holocal.loop.preflight.expectations import Expectations
from holocal.loop.procedure import Plan
from holocal.loop.reference import not_hot
from holocal.loop.shooting import Shooter, guarded
from holocal.records.facts import RigFacts
from holocal.records.rig import identity

RECORD_BYTES = 64 * 2**20  # maps, report, checkpoints
OFFSET_LIMIT = 0.25  # of full scale: a dark frame above it means ambient light or a wrong black level
NOISE_LIMIT = 0.05  # of full scale
HOT_LIMIT = 1e-3  # share of pixels
HOT_LEVEL = 0.5  # of full scale: fainter ones are taken off with the dark frame
OLD_DAYS = 30.0  # a bench that is used is touched within a month


def lock_check(lock: Path | None) -> Check:
    """Return whether this process holds the rig's lock (P01)."""
    title, mine = "lock of the rig", f"process {os.getpid()}"
    owner = lock.read_text(encoding="utf-8").strip() if lock is not None and lock.is_file() else ""
    if not owner:  # nobody locks, or a system without flock
        return unknown("P01", title, "See to it that no other program uses the rig.")
    return Check("P01", title, owner, mine, "", PASS if owner == mine else FAIL, "Wait for the other program to end.")


def disk_check(directory: Path, facts: RigFacts, plan: Plan | None) -> Check:
    """Return whether the run's files fit on its disk (P02)."""
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


def identity_check(facts: RigFacts, expected: Expectations) -> Check:
    """Return whether the devices are those that the rig's file and its accepted calibration name (P03)."""
    found = identity(facts)
    wrong = [
        (key, found.get(key), value, who)
        for who, values in expected.identity.items()
        for key, value in values.items()
        if found.get(key) != value
    ]
    title = "the rig is the one that is meant"
    devices = f"{facts.slm.serial or 'SLM'}, {facts.camera.serial or 'camera'}"
    if not wrong:
        asked = ", ".join(expected.identity) or "nothing asked for"
        return Check("P03", title, devices, asked, "", PASS, "")
    key, value, wanted, who = wrong[0]
    more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
    remedy = f"Connect the device that {who} names, or give this bench a file of its own and measure it anew."
    return Check("P03", title, f"{key} = {value!r}{more}", f"{wanted!r} ({who})", "", FAIL, remedy)


def age_check(expected: Expectations, now: datetime | None = None) -> Check:
    """Return whether the calibration in force is young enough (P14): a warning, or a refusal where the rig says so."""
    title, limit = "age of the calibration in force", expected.max_age_days or OLD_DAYS
    remedy = "Measure again (`holocal run PROCEDURE --corrections none`), then `holocal accept`."
    ages = {
        name: ((now or datetime.now(UTC)) - when).total_seconds() / 86400
        for name, when in expected.measured_utc.items()
        if when is not None
    }
    if not ages:
        if expected.measured_utc:
            return unknown("P14", title, remedy)
        return Check("P14", title, "none in force", limit, "days", PASS, remedy)
    oldest = max(ages, key=lambda name: ages[name])
    otherwise = WARN if expected.max_age_days is None else FAIL
    measured = round(ages[oldest], 2)
    return check("P14", title, measured, limit, "days", f"The oldest is {oldest}. {remedy}", otherwise=otherwise)


def output_checks(rig: Rig) -> list[Check]:
    """Return what the devices say of how they are set up (P04); one line of "unknown" where none can say anything."""
    checks = []
    for name, device in (("SLM", rig.slm), ("camera", rig.camera), ("light", rig.light)):
        if isinstance(device, Inspectable):
            checks += [from_finding("P04", name, found) for found in guarded(device.inspect, f"the {name}")]
    remedy = "Check by eye: native mode, no scaling, no rotation, no gamma ramp, no night light."
    return checks or [unknown("P04", "SLM: output state", remedy)]


def read_back_check(shooter: Shooter, levels: NDArray[np.uint8]) -> Check:
    """Return whether the panel has what it was sent, by its own read-back (P05)."""
    title, remedy = (
        "read-back of a random pattern",
        "Check scaling, rotation and colour settings of the panel's output.",
    )
    arrived = shooter.read_back(levels)
    if arrived is None:
        return unknown("P05", title, "The panel cannot be read back; P10 and P11 see by the camera what it shows.")
    return Check(
        "P05", title, "the same" if arrived else "something else", "the same", "", PASS if arrived else FAIL, remedy
    )


def dark_checks(darks: Sequence[Frame], facts: RigFacts) -> list[Check]:
    """Return offset, noise and hot pixels of frames taken without light (P06)."""
    scale = facts.camera.full_scale
    counts = np.asarray(darks[-1].counts, np.float64)
    offset = float(np.median(counts))
    usable = not_hot(darks[-1])
    noise = float(np.std((counts - np.asarray(darks[0].counts, np.float64))[usable])) / np.sqrt(2.0)
    hot = counts > offset + max(10.0 * noise, HOT_LEVEL * scale)
    return [
        check("P06a", "dark offset", offset / scale, OFFSET_LIMIT, "of full scale", "Shut out ambient light."),
        check("P06b", "dark noise", noise / scale, NOISE_LIMIT, "of full scale", "Lower the camera's gain or cool it."),
        check("P06c", "hot pixels", float(hot.mean()), HOT_LIMIT, "of pixels", "Shut out light, or cool the camera."),
    ]
