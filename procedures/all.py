"""All procedures of a bench in one run, each with what the previous ones found in force for it.

==========  ==================================================================================
response    first: every other frame is made of levels, and needs nothing itself but light
distortion  then: a mirrored or turned camera is refused here, from two frames of spots
aberration  then: made with the response, measured zone by zone wherever the spots lie
uniformity  last: what a viewer sees; the others move its light, and it moves none of theirs
==========  ==================================================================================

A stage that missed its targets is told and not built upon; the others are measured all the same. Why in this order:
docs/decisions/0019.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from holocal.loop.devices import Frame
from holocal.loop.procedure import (
    AgainstTruth,
    Conclusion,
    Figure,
    Judgement,
    Outcome,
    Plan,
    Shot,
    ToldOfCamera,
)
from holocal.loop.reference import Reference
from holocal.records.calibration import Accepted
from holocal.records.facts import RigFacts
from holocal.records.maps import Maps
from holocal.records.results import main_number, numbers_of
from procedures.aberration import Aberration
from procedures.aberration import Parameters as AberrationParameters
from procedures.distortion import Distortion
from procedures.distortion import Parameters as DistortionParameters
from procedures.response import Parameters as ResponseParameters
from procedures.response import Response
from procedures.uniformity import Parameters as UniformityParameters
from procedures.uniformity import Uniformity

STAGES: tuple[Any, ...] = (Response(), Distortion(), Aberration(), Uniformity())  # each a `Procedure`

ENOUGH_RAD = 0.005  # expected error of the response's table: a quarter of its target


def quick_response() -> ResponseParameters:
    """Return the response's parameters where it is one of four: fewer levels, more only where the curve bends."""
    return ResponseParameters(levels_per_step=5, verify_levels=8, enough_rad=ENOUGH_RAD)


class Parameters(BaseModel):
    """The parameters of each stage, `--set uniformity.floor=0.3`; `device` is where all of them compute."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    response: ResponseParameters = Field(default_factory=quick_response)
    distortion: DistortionParameters = Field(default_factory=DistortionParameters)
    aberration: AberrationParameters = Field(default_factory=AberrationParameters)
    uniformity: UniformityParameters = Field(default_factory=UniformityParameters)
    device: str = "cpu"

    def of(self, stage: str) -> Any:
        """Return a stage's parameters, on the device that was chosen."""
        return getattr(self, stage).model_copy(update={"device": self.device})


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps.

    `inner` is the state of stage number `stage`, `verifying` whether its loop has ended, `told` its last judgement.
    `done` are the conclusions of the stages before.
    """

    facts: RigFacts
    parameters: Parameters
    seed: int
    reference: Reference | None
    stage: int
    inner: Any
    verifying: bool
    told: Judgement
    done: tuple[Conclusion, ...]


class All:
    """The procedure `all` (see `holocal.loop.procedure.Procedure`)."""

    name = "all"
    parameters_model = Parameters

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        plans = [stage.plan(facts, parameters.of(stage.name)) for stage in STAGES]
        return Plan(
            frames=sum(plan.frames for plan in plans),
            steps=sum(plan.steps for plan in plans) + len(STAGES) - 1,  # all but the last are verified in a step
            expected_seconds=sum(plan.expected_seconds for plan in plans),
            exposure_ceiling_s=max(plan.exposure_ceiling_s for plan in plans),
            sentences=tuple(
                f"{stage.name}: {said}" for stage, plan in zip(STAGES, plans, strict=True) for said in plan.sentences
            ),
            tolerated_drift=min(plan.tolerated_drift for plan in plans),
        )

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known, and nothing that was accepted before is built upon."""
        state = State(facts, parameters, seed, None, 0, None, False, Judgement(Outcome.CONTINUE, ""), ())
        return _begun(state, 0)

    def with_camera(self, state: State, reference: Reference) -> State:
        """Return the state told of the camera."""
        return _begun(replace(state, reference=reference), state.stage)

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the frames of a stage's step, or of its verification."""
        stage = STAGES[state.stage]
        shots = stage.verification(state.inner) if state.verifying else stage.stimuli(state.inner)
        for shot in shots:
            yield replace(shot, label=f"{stage.name}-{shot.label}")

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state after a stage's step, or with its conclusion and the next stage begun."""
        stage = STAGES[state.stage]
        if state.verifying:
            done = (*state.done, stage.conclude(state.inner, frames))
            return _begun(replace(state, done=done, verifying=False), state.stage + 1)
        inner = stage.update(state.inner, frames)
        told = stage.judge(inner)
        return replace(state, inner=inner, told=told, verifying=told.outcome is not Outcome.CONTINUE)

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        if _just_concluded(state):
            stage, concluded = STAGES[state.stage - 1], state.done[-1]
            name = _main(concluded)
            said = numbers_of({"after": concluded.after, "targets": concluded.targets}, "after").get(name)
            value, target = (None, None) if said is None else (said.value, said.target)
            sigma = concluded.sigma.get("after", {}).get(name)
            return {"quantity": f"{stage.name}: {name}", "value": value, "sigma": sigma, "target": target}
        stage = STAGES[state.stage]
        said_so = stage.progress(state.inner)
        return {**said_so, "quantity": f"{stage.name}: {said_so.get('quantity', 'value')}"}

    def judge(self, state: State) -> Judgement:
        """Return whether to go on: until the last stage is to be verified."""
        if _just_concluded(state):
            return Judgement(Outcome.CONTINUE, f"{STAGES[state.stage - 1].name}: {state.done[-1].sentence}")
        said = f"{STAGES[state.stage].name}: {state.told.sentence}"
        if not state.verifying or state.stage + 1 < len(STAGES):
            return Judgement(Outcome.CONTINUE, said)
        met = state.told.outcome is Outcome.TARGET_MET and not all(one.targets_met for one in state.done)
        return Judgement(Outcome.OUT_OF_STEPS if met else state.told.outcome, said)

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield the frames of the last stage's verification."""
        return self.stimuli(state)

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return all stages' results as one."""
        last = STAGES[state.stage].conclude(state.inner, frames)
        return joined({stage.name: one for stage, one in zip(STAGES, (*state.done, last), strict=True)})

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return how far each stage's result is from the simulated bench's truth."""
        parts = zip(STAGES, conclusion.parts.items(), strict=True)
        return {
            name: stage.against_truth(part, truth) for stage, (name, part) in parts if isinstance(stage, AgainstTruth)
        }


def joined(parts: Mapping[str, Conclusion]) -> Conclusion:
    """Return the conclusions of several procedures as one, whose targets hold when all of theirs do."""
    missed = [name for name, one in parts.items() if not one.targets_met]
    last = list(parts.values())[-1]
    verdict = "all targets are met" if not missed else f"not met: {', '.join(missed)}"
    sentences = [f"{name}: {one.sentence}" for name, one in parts.items()]
    return Conclusion(
        before={name: one.before for name, one in parts.items()},
        after={name: one.after for name, one in parts.items()},
        targets=_flat({name: one.targets for name, one in parts.items()}),
        targets_met=not missed,
        sentence=f"{verdict}. " + ". ".join(sentences),
        maps={},
        before_map=last.before_map,
        after_map=last.after_map,
        map_units=last.map_units,
        extent_deg=last.extent_deg,
        sigma={
            side: _flat({name: one.sigma.get(side, {}) for name, one in parts.items()}) for side in ("before", "after")
        },
        figures=tuple(_titled(name, figure) for name, one in parts.items() for figure in one.figures),
        parts=dict(parts),
    )


def _flat(tables: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    return {f"{name}_{key}": value for name, table in tables.items() for key, value in table.items()}


def _titled(name: str, figure: Figure) -> Figure:
    return replace(figure, name=f"{name}-{figure.name}", title=f"{name.capitalize()}: {figure.title}")


def _begun(state: State, number: int) -> State:
    """Return the state with a stage at its start, the stages before it in force."""
    stage, chosen = STAGES[number], state.parameters.of(STAGES[number].name)
    inner = stage.start(state.facts, _in_force(state), chosen, state.seed)
    if state.reference is not None and isinstance(stage, ToldOfCamera):
        inner = stage.with_camera(inner, state.reference)
    return replace(state, stage=number, inner=inner, told=Judgement(Outcome.CONTINUE, ""))


def _in_force(state: State) -> dict[str, Accepted]:
    """Return what the stages before found, as if it were accepted; what missed its targets is left out."""
    found = {}
    for stage, one in zip(STAGES, state.done, strict=False):
        if one.targets_met and one.extra.get("correction") != "none":
            maps = {name: np.asarray(values, np.float32) for name, values in one.maps.items()}
            metadata = {"extent_deg": one.extent_deg, **one.map_metadata}
            found[stage.name] = Accepted(stage.name, "", "", one.extra, Maps(maps, metadata))
    return found


def _just_concluded(state: State) -> bool:
    return state.stage > 0 and not state.told.sentence and not state.verifying


def _main(concluded: Conclusion) -> str:
    return main_number({"after": concluded.after, "targets": concluded.targets}) or "result"
