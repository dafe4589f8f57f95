"""Aberration: the wavefront of every zone of the field, and its correction, in one of three ways.

======  =======================  ==================================================================
mode    file                     does
======  =======================  ==================================================================
model   `_aberration_model.py`   fits a model of the spots' pictures: six frames
search  `_aberration_search.py`  needs no model of the bench: 86 to 118 frames
sweep   `_aberration_sweep.py`   a contact sheet of one polynomial, for the eye; corrects nothing
======  =======================  ==================================================================

All three find exposure and spots with the same first frame.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Judgement, Plan, Remeasured, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures._aberration_model import ModelMode
from procedures._aberration_search import SearchMode
from procedures._aberration_sweep import SweepMode

Mode = ModelMode | SearchMode | SweepMode
MODES: dict[str, Mode] = {"model": ModelMode(), "search": SearchMode(), "sweep": SweepMode()}


class Parameters(BaseModel):
    """What may be chosen. `noll_max` is the last Noll index that is corrected, the first is 4.

    `max_steps` is of mode model, as is `posterior`: to sample a zone's posterior, which takes a minute more.
    `search_passes` is of mode search (a pass is 32 frames for 12 modes); the `sweep_` parameters are of mode sweep:
    coefficients of one polynomial over the whole pupil, radians.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mode: Literal["model", "search", "sweep"] = "model"
    zones: int = Field(default=5, ge=2, le=15)
    noll_max: int = Field(default=15, ge=4, le=36)
    wavelength_nm: float = Field(default=515.0, gt=0.0)
    target_median_rad: float = Field(default=0.05, gt=0.0)
    target_worst_rad: float = Field(default=0.15, gt=0.0)
    max_steps: int = Field(default=3, ge=2, le=10)
    posterior: bool = False
    search_passes: int = Field(default=3, ge=1, le=5)
    sweep_noll: int = Field(default=4, ge=4, le=36)
    sweep_from_rad: float = Field(default=-3.0, ge=-20.0, le=20.0)
    sweep_to_rad: float = Field(default=3.0, ge=-20.0, le=20.0)
    sweep_steps: int = Field(default=9, ge=4, le=41)
    device: str = "cpu"

    @model_validator(mode="after")
    def _sweep_rises(self) -> Parameters:
        if not self.sweep_from_rad < self.sweep_to_rad:
            raise ValueError(f"sweep_from_rad {self.sweep_from_rad:g} is not below sweep_to_rad {self.sweep_to_rad:g}")
        return self

    @property
    def noll(self) -> tuple[int, ...]:
        """The Noll indices that are corrected."""
        return tuple(range(4, self.noll_max + 1))


class Aberration:
    """The procedure `aberration` (see `holocal.loop.procedure.Procedure`): each call goes to the chosen mode."""

    name = "aberration"
    parameters_model = Parameters

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        return MODES[parameters.mode].plan(facts, parameters)

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> Any:
        """Return the first state: nothing is known."""
        return MODES[parameters.mode].start(facts, calibration, parameters, seed)

    def with_camera(self, state: Any, reference: Reference) -> Any:
        """Return the state told of the camera: its noise, its dark level, and the light of a random pattern."""
        return _mode_of(state).with_camera(state, reference)

    def stimuli(self, state: Any) -> Iterator[Shot]:
        """Yield the frames of a step."""
        return _mode_of(state).stimuli(state)

    def update(self, state: Any, frames: tuple[Frame, ...]) -> Any:
        """Return the state after a step's frames."""
        return _mode_of(state).update(state, frames)

    def progress(self, state: Any) -> dict[str, Any]:
        """Return the journal line of the last step."""
        return _mode_of(state).progress(state)

    def judge(self, state: Any) -> Judgement:
        """Return whether to go on."""
        return _mode_of(state).judge(state)

    def verification(self, state: Any) -> Iterator[Shot]:
        """Yield frames with fresh phases that no estimate has seen."""
        return _mode_of(state).verification(state)

    def conclude(self, state: Any, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result; "after" is measured on the verification's frames only."""
        return _mode_of(state).conclude(state, frames)

    def remeasure(
        self,
        facts: RigFacts,
        calibration: Mapping[str, Any],
        parameters: Parameters,
        reference: Reference,
        seed: int,
    ) -> Generator[Shot, Frame, Remeasured]:
        """Yield the frames that measure the accepted correction; return what it leaves."""
        from procedures._aberration_check import remeasured

        return remeasured(facts, calibration, parameters, reference, seed)

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the correction leaves of the simulated bench's exact phase."""
        return MODES[conclusion.extra["mode"]].against_truth(conclusion, truth)


def _mode_of(state: Any) -> Mode:
    return MODES[state.parameters.mode]
