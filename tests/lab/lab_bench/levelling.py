"""A procedure that is quick: it averages frames until their mean is known well enough."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Figure, Judgement, Outcome, Plan, Remeasured, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts


class Parameters(BaseModel):
    """How many steps, and how good is good enough."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    steps: int = Field(default=3, ge=1, le=50)
    target: float = Field(default=0.5, gt=0.0)
    exposure_s: float = Field(default=0.02, gt=0.0, le=1.0)
    bug_at: int = 0
    slow_s: float = 0.0


@dataclass(frozen=True)
class Size:
    """Nested on purpose: a checkpoint keeps it."""

    width: int
    height: int


@dataclass(frozen=True)
class State:
    """The sum of the frames so far."""

    size: Size
    parameters: Parameters
    seed: int
    step: int
    total: NDArray[np.float64]
    means: tuple[float, ...]
    note: str = ""


class Levelling:
    """Averages frames until their mean is known well enough."""

    name = "levelling"
    parameters_model = Parameters

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        return Plan(parameters.steps + 1, parameters.steps, 0.1, parameters.exposure_s, ("nothing moves",))

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        size = Size(facts.slm.width, facts.slm.height)
        total = np.zeros((facts.camera.height, facts.camera.width))
        return State(size, parameters, seed, 0, total, (), ",".join(sorted(calibration)))

    def stimuli(self, state: State) -> Iterator[Shot]:
        yield self._shot(state, "square", state.step)

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        time.sleep(state.parameters.slow_s)
        if state.step + 1 == state.parameters.bug_at:
            raise ZeroDivisionError("a bug of the procedure")
        picture = frames[0].counts / frames[0].exposure_s
        return replace(
            state,
            step=state.step + 1,
            total=state.total + picture,
            means=(*state.means, float(picture.mean())),
        )

    def progress(self, state: State) -> dict[str, Any]:
        return {
            "quantity": "spread of the means",
            "value": float(np.std(state.means) / np.mean(state.means)),
            "sigma": 0.01,
            "target": state.parameters.target,
        }

    def judge(self, state: State) -> Judgement:
        if state.step < state.parameters.steps:
            return Judgement(Outcome.CONTINUE, "go on")
        return Judgement(Outcome.TARGET_MET, "enough")

    def verification(self, state: State) -> Iterator[Shot]:
        yield self._shot(state, "verify", 1000)

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        after = (frames[0].counts / frames[0].exposure_s).astype(np.float32)
        spread = float(abs(after.mean() / np.mean(state.means) - 1.0))
        mean = (state.total / state.step).astype(np.float32)
        valid = np.ones(mean.shape)
        valid[:5] = 0
        return Conclusion(
            before={"spread": state.means[0]},
            after={"spread": spread},
            targets={"spread": state.parameters.target},
            targets_met=spread <= state.parameters.target,
            sentence=f"spread {spread:.3g}, target {state.parameters.target:.3g}",
            maps={"correction.intensity_weight": mean / mean.max(), "valid": valid.astype(np.float32)},
            before_map=mean,
            after_map=after,
            extra={"mean": float(after.mean())},
            extent_deg=(-12.5, 12.5, -10.0, 10.0),
            figures=(
                Figure("field", "The field", "pair", {"before": mean, "after": after, "valid": valid}, "counts/s"),
                Figure("mean", "Mean", "map", {"mean": mean, "valid": valid}, "counts/s", "averaged"),
                Figure("means", "Means", "curve", {"x": np.arange(state.step), "y": np.array(state.means)}, target=1.0),
                Figure("values", "Values", "histogram", {"before": mean, "after": after}),
                Figure("picture", "Picture", "image", {"picture": after}),
            ),
        )

    def remeasure(
        self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, reference: Reference, seed: int
    ) -> Generator[Shot, Frame, Remeasured]:
        state = self.start(facts, calibration, parameters, seed)
        frame = yield self._shot(state, "check", 2000)
        was = float(calibration[self.name].result["mean"])
        return Remeasured({"spread": abs(float(np.mean(frame.counts)) / frame.exposure_s / was - 1)}, {"spread": 0.02})

    def _shot(self, state: State, label: str, number: int) -> Shot:
        noise = np.random.default_rng([state.seed, number])
        levels = noise.integers(0, 256, (state.size.height, state.size.width), np.uint8)
        return Shot(label, levels, state.parameters.exposure_s, 515e-9, keep=label == "verify")
