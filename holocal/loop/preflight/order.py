"""The pre-flight's checks in turn: the light goes on only when all that can be checked without it is well."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from holocal.loop.preflight.checks import Check, failed
from holocal.loop.preflight.expectations import NOTHING_EXPECTED, Expectations
from holocal.loop.preflight.panel import panel_checks
from holocal.loop.preflight.with_light import Bench, camera_checks
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
    pattern = np.random.default_rng(0).integers(0, 2**facts.slm.bits, (facts.slm.height, facts.slm.width), np.uint8)
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
    found, series = camera_checks(bench, darks, tolerated)
    return by_number([*checks, *found, *panel_checks(bench, darks, series)])


def by_number(checks: list[Check]) -> list[Check]:
    """Return checks in the order of their numbers."""
    return sorted(checks, key=lambda item: item.id)
