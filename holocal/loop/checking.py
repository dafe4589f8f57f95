"""An accepted calibration measured again: a few shots per procedure, nothing corrected, nothing kept."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from holocal.errors import InputError, RefusedError
from holocal.loop.devices import Repeatable, Rig
from holocal.loop.procedure import Checkable, Remeasured
from holocal.loop.reference import Reference
from holocal.loop.shooting import Shooter


@dataclass(frozen=True)
class Rechecked:
    """What was found anew; `found` is None, and `reason` says why, where the frames do not show the calibration."""

    found: Remeasured | None
    reason: str
    frames: int
    seconds: float


def recheck(
    procedure: Checkable,
    rig: Rig,
    shooter: Shooter,
    calibration: Mapping[str, Any],
    parameters: Any,
    *,
    reference: Reference,
    seed: int,
    step: int,
) -> Rechecked:
    """Return what a procedure's accepted result leaves now, from frames taken with a shooter that passed a pre-flight.

    `step` tells the noise of a simulated rig apart from that of other procedures.
    """
    began, taken = time.monotonic(), shooter.frames
    shooter.begin_step()
    if isinstance(rig, Repeatable):
        rig.begin_step(seed, step)
    asked = procedure.remeasure(shooter.facts, calibration, parameters, reference, seed)
    found, reason = None, ""
    try:
        shot = next(asked)
        while True:
            frame = shooter.shoot(shot)
            try:
                shot = asked.send(frame)
            except (RefusedError, InputError) as error:
                reason = error.what
                break
    except StopIteration as end:
        found = end.value
    finally:
        asked.close()
    return Rechecked(found, reason, shooter.frames - taken, time.monotonic() - began)
