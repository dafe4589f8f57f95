"""The pre-flight's checks in turn: the light goes on only when all that can be checked without it is well."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from holocal.loop.devices import Frame
from holocal.loop.drift import random_pattern
from holocal.loop.preflight.checks import Check, failed
from holocal.loop.preflight.expectations import NOTHING_EXPECTED, Expectations
from holocal.loop.preflight.panel import (
    change_to_blank,
    change_to_pattern,
    counts_of,
    fresh_frames,
    mean_picture,
    panel_checks,
)
from holocal.loop.preflight.with_light import Bench, camera_checks, of_one_exposure, pattern_series
from holocal.loop.preflight.without_light import (
    age_check,
    dark_checks,
    disk_check,
    identity_check,
    lock_check,
    output_checks,
    read_back_check,
)
from holocal.loop.procedure import Plan
from holocal.loop.reference import make_reference, not_hot
from holocal.loop.shooting import Shooter
from holocal.records.facts import RigFacts

TOLERATED_DRIFT = Plan(0, 0, 0.0, 0.0).tolerated_drift  # where no procedure says what it stands


def preflight(
    shooter: Shooter,
    facts: RigFacts,
    plan: Plan | None,
    directory: Path,
    expected: Expectations = NOTHING_EXPECTED,
) -> list[Check]:
    """Return the checks of a rig by their number: those without light, and those with it when none of these failed.

    Raises
    ------
    SafetyStop
        The picture clips at the camera's shortest exposure.
    DeviceError
        A device failed, or a frame is not what the camera says of itself.
    """
    pattern = random_pattern(facts)
    bench = Bench(shooter, facts, pattern)
    shooter.light_off()
    checks = [
        lock_check(expected.lock),
        disk_check(directory, facts, plan),
        identity_check(facts, expected),
        age_check(expected),
        *output_checks(shooter.rig),
    ]
    if not failed(checks):
        checks.append(read_back_check(shooter, pattern))
    if failed(checks):
        return by_number(checks)
    longest_s = facts.camera.exposure_max_s if plan is None else plan.exposure_ceiling_s
    # Between the shortest and the longest: at the longest, dark current alone may fill the well of a warm camera.
    usual_s = float(np.sqrt(facts.camera.exposure_min_s * longest_s))
    darks = [bench.dark(exposure_s) for exposure_s in (facts.camera.exposure_min_s, usual_s)]
    checks += dark_checks(darks, facts)
    if failed(checks):
        return by_number(checks)
    tolerated = TOLERATED_DRIFT if plan is None else plan.tolerated_drift
    return by_number([*checks, *_with_light(bench, darks, tolerated)])


def _with_light(bench: Bench, darks: list[Frame], tolerated_drift: float) -> list[Check]:
    """Return the checks with light; the shooter is told what was learnt of camera and light."""
    usable = not_hot(darks[-1])
    series = pattern_series(bench, float(np.median(darks[-1].counts)))
    same = of_one_exposure(series)
    pattern = mean_picture(same)
    to_blank = change_to_blank(bench, pattern, usable)
    to_pattern = change_to_pattern(bench, pattern, counts_of(to_blank.frames[-1]), usable)
    if bench.exposure_s > darks[-1].exposure_s:  # the dark level is not to be extrapolated
        darks = [*darks, bench.dark(bench.exposure_s)]
    bench.shooter.reference = reference = make_reference((darks[0], darks[-1]), same)
    return [
        *camera_checks(series, reference, bench.facts, tolerated_drift=tolerated_drift),
        *panel_checks(same, to_blank, to_pattern, usable),
        fresh_frames([*darks[:2], *series, *to_blank.frames, *to_pattern.frames, *darks[2:]]),
    ]


def by_number(checks: list[Check]) -> list[Check]:
    """Return checks in the order of their numbers."""
    return sorted(checks, key=lambda item: item.id)
