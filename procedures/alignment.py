"""Alignment: the pose of mirror and panel that explains where spots are seen, and which screws bring the bench within
tolerance.

The spots are those of `distortion`: two grids of known field angles, each shown with defocus of both signs. Where a
spot is seen in either tells where its rays land and how the wavefront bends, so that the twelve displacements follow
from four frames. Other spots, made for the bench so found and in another of the rig's colours, verify it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Judgement, Outcome, Plan, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures import distortion
from procedures._holograms import response_in_force

Array = NDArray[np.float64]

VERIFICATION = 2000  # the step number that seeds the verification's phases
VERIFIED = (1.0, -1.0)  # signs of the defocus
CLIP_LIMIT = 3e-4


class Parameters(BaseModel):
    """What may be chosen.

    `tolerance_px` and `tolerance_rad` are what an aligned bench may leave: the picture's displacement and the wavefront
    (both rms over the field), which the moves of the screws are to reach. `verify_nm` is the colour that the prediction
    is verified in, 0 the rig's farthest from `wavelength_nm`. `camera_px` is how well the camera's own pointing, roll
    and scale are known, pixels at the picture's edge; 0: 0.02 of a simulated camera, 2 of a real one. What is not known
    of the camera is not told of the bench.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    points: int = Field(default=9, ge=5, le=25)
    wavelength_nm: float = Field(default=515.0, gt=0.0)
    verify_nm: float = Field(default=0.0, ge=0.0)
    target_rad: float = Field(default=0.05, gt=0.0)
    target_px: float = Field(default=0.2, gt=0.0)
    tolerance_px: float = Field(default=5.0, gt=0.0)
    tolerance_rad: float = Field(default=0.25, gt=0.0)
    prior_deg: float = Field(default=1.0, gt=0.0)
    prior_mm: float = Field(default=1.0, gt=0.0)
    camera_px: float = Field(default=0.0, ge=0.0)
    device: str = "cpu"


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps: the spots, as `distortion` measures them, and the fit to them.

    `values` (p,) and `covariance` (p, p) of `procedures._bench_light.PARAMETERS`, `information` (p, p) of the data
    alone; empty before the fit. `residual` (m,) of the middles, in standard errors. `verify_rad` is the panel's
    response at the verification's wavelength.
    """

    spots: distortion.State
    parameters: Parameters
    verify_rad: Array
    verify_nm: float
    values: Array
    covariance: Array
    information: Array
    residual: Array

    @property
    def facts(self) -> RigFacts:
        """The rig's facts."""
        return self.spots.facts


class Alignment:
    """The procedure `alignment` (see `holocal.loop.procedure.Procedure`)."""

    name = "alignment"
    parameters_model = Parameters

    def __init__(self) -> None:
        self._spots = distortion.Distortion()

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        planned = self._spots.plan(facts, _of_spots(parameters))
        return replace(
            planned,
            expected_seconds=planned.expected_seconds + 20,
            sentences=(
                planned.sentences[0],
                f"{len(VERIFIED)} frames of other spots at {_verify_nm(facts, parameters):g} nm, made for the bench "
                "that was found, for the verification alone",
            ),
        )

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known."""
        verify_nm = _verify_nm(facts, parameters)
        return State(
            spots=self._spots.start(facts, calibration, _of_spots(parameters), seed),
            parameters=parameters,
            verify_rad=response_in_force(calibration, facts, verify_nm),
            verify_nm=verify_nm,
            values=np.zeros(0),
            covariance=np.zeros((0, 0)),
            information=np.zeros((0, 0)),
            residual=np.zeros(0),
        )

    def with_camera(self, state: State, reference: Reference) -> State:
        """Return the state told of the camera: its noise, its dark level, and the light of a random pattern."""
        return replace(state, spots=self._spots.with_camera(state.spots, reference))

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the spots of the next step."""
        return self._spots.stimuli(state.spots)

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state with more spots seen, or with the bench that explains all of them."""
        from procedures._alignment_fit import with_fit

        state = replace(state, spots=self._spots.update(state.spots, frames))
        return with_fit(state) if len(state.spots.sent_tan) else state

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        if not len(state.values):
            return self._spots.progress(state.spots)
        return {
            "quantity": "spots off the fitted bench (rms)",
            "value": float(np.sqrt(np.nanmean(state.residual**2))),
            "sigma": None,
            "target": None,
            "unit": "standard errors",
        }

    def judge(self, state: State) -> Judgement:
        """Return whether to go on: the bench is fitted once, and verified."""
        if not len(state.values):
            return self._spots.judge(state.spots)
        count = int(np.count_nonzero(np.isfinite(state.residual))) // 4
        said = (
            f"a bench explains {count} spots to {np.sqrt(np.nanmean(state.residual**2)):.2g} of their standard errors"
        )
        return Judgement(Outcome.TARGET_MET, f"{said}: verified with others")

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield other spots in another colour, sent by holograms for the bench that was found."""
        from procedures._alignment_fit import verification_exposure_s, verification_levels

        for number, sign in enumerate(VERIFIED):
            yield Shot(
                label=f"verify-{'plus' if sign > 0 else 'minus'}",
                levels=verification_levels(state, sign, (state.spots.seed, VERIFICATION, number)),
                exposure_s=verification_exposure_s(state),
                wavelength_m=state.verify_nm * 1e-9,
                clip_limit=CLIP_LIMIT,
                keep=number == 0,
            )

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result; `position_rms_px` after is measured on the verification's frames only."""
        from procedures._alignment_result import conclusion

        return conclusion(state, frames)

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return the simulated bench's displacements, and what the fitted bench leaves of its exact phase."""
        from procedures._alignment_truth import against_truth

        return against_truth(conclusion, truth)


def _of_spots(parameters: Parameters) -> distortion.Parameters:
    return distortion.Parameters(
        points=parameters.points, wavelength_nm=parameters.wavelength_nm, device=parameters.device
    )


def _verify_nm(facts: RigFacts, parameters: Parameters) -> float:
    if parameters.verify_nm:
        return parameters.verify_nm
    lines = np.array(facts.wavelengths_m) * 1e9
    return float(lines[np.argmax(np.abs(lines - parameters.wavelength_nm))])
