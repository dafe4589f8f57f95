"""How far the light drifted over a run: the pre-flight's random pattern is looked at once more at its end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.loop.procedure import Plan, Shot
from holocal.loop.shooting import Shooter
from holocal.records.facts import RigFacts

# Of what a procedure stands within the pre-flight's few frames: over a run the light may go five times as far (2 and
# 10 % for a procedure that says nothing), since frames are then compared with their neighbours, not all with the first.
OVER_RUN = 5.0


@dataclass(frozen=True)
class Drift:
    """The relative change of the light's rate from the pre-flight to the end of a run."""

    relative: float
    limit: float

    @property
    def ok(self) -> bool:
        """Whether the run's frames belong together."""
        return abs(self.relative) <= self.limit

    @property
    def sentence(self) -> str:
        """What was found, with the limit."""
        return f"the light changed by {self.relative:+.1%} over the run (limit {self.limit:.0%})"


def random_pattern(facts: RigFacts) -> NDArray[np.uint8]:
    """Return the levels (height, width) that spread the light over every direction, the same in every run."""
    panel = facts.slm
    return np.random.default_rng(0).integers(0, 2**panel.bits, (panel.height, panel.width), np.uint8)


def drift_over_run(shooter: Shooter, facts: RigFacts, plan: Plan) -> Drift | None:
    """Return the drift since the pre-flight, from one more frame; None where it saw no light."""
    reference = shooter.reference
    if reference is None or reference.rate <= 0:
        return None
    lines = facts.wavelengths_m
    shot = Shot(
        "closing pattern",
        random_pattern(facts),
        reference.exposure_s,
        lines[len(lines) // 2],
        clip_limit=1.0,
        fresh=False,
    )
    frame = shooter.frame(shot)
    rate = float(reference.signal(frame)[reference.usable].mean()) / frame.exposure_s
    return Drift(rate / reference.rate - 1, OVER_RUN * plan.tolerated_drift)
