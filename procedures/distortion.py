"""Distortion: where the picture is seen against where it was sent, and the map that sends it where it is to be seen.

Spots at known field angles are shown in pairs of opposite defocus, so that each is 6 pixels wide and its middle is
where it is in focus; one coherent spot has no speckle. Two irregular grids make the map, the second sent where the
first says that it will fill the camera's picture (`mode` grid: a homography, polynomials and a spline as far as
held-out spots want them; `mode` corners: the thesis's homography of the four outermost spots), a third, sent through
the inverse map, verifies it.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Judgement, Outcome, Plan, Remeasured, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures._holograms import response_in_force

Array = NDArray[np.float64]
Pictures = NDArray[np.uint16]

FIRST_PEAK, WANTED_PEAK = 0.3, 0.6  # of full scale, of the brightest spot's pixels: foreseen, and once seen
CLIPPED, FAINT = 1e-4, 0.04  # share of clipped pixels; of full scale, the brightest: beyond, the first frame is retaken
SEARCHES = 4
CLIP_LIMIT = 3e-4
VERIFICATION = 1000  # the step number that seeds the verification's phases
FIRST, SECOND = ((0, -1.0),), ((1, 1.0), (1, -1.0))  # grid and sign of the defocus of the frames after the first
VERIFIED = (1.0, -1.0)


class Parameters(BaseModel):
    """What may be chosen; `points` is the first grid's side, the second has one more, the verification one less."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mode: Literal["grid", "corners"] = "grid"
    points: int = Field(default=9, ge=5, le=25)
    wavelength_nm: float = Field(default=515.0, gt=0.0)
    target_rms_px: float = Field(default=0.10, gt=0.0)
    target_max_px: float = Field(default=0.35, gt=0.0)
    device: str = "cpu"


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps.

    `pictures` (n, height, width) of the frames taken, `exposures_s` (n,), `grids` (n,) which grid each shows.
    `exposure_s` 0 means that it is still looked for, from `guess_s`. `second_tan` (m, 2) is where the second grid is
    sent, empty before the first is seen. `sent_tan` and `wanted_tan` (k, 2) are the
    verification's spots, `light_values` the beam and bench that explain the spots (`procedures._bench_light`); empty
    before the map is made.
    """

    facts: RigFacts
    parameters: Parameters
    response_rad: Array
    seed: int
    step: int
    searched: int
    guess_s: float
    exposure_s: float
    reference: Reference | None
    pictures: Pictures
    exposures_s: Array
    grids: NDArray[np.int64]
    second_tan: Array
    sent_tan: Array
    wanted_tan: Array
    light_values: Array
    rms_px: float
    noise_px: float


class Distortion:
    """The procedure `distortion` (see `holocal.loop.procedure.Procedure`)."""

    name = "distortion"
    parameters_model = Parameters

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        more = len(FIRST) + len(SECOND) * (parameters.mode == "grid")
        frames = 1 + more + len(VERIFIED)
        megapixels = facts.slm.width * facts.slm.height / 1e6
        shown = parameters.points**2 + (parameters.points + 1) ** 2 * (parameters.mode == "grid")
        return Plan(
            frames=frames,
            steps=3 if parameters.mode == "grid" else 2,
            expected_seconds=5 + frames * (0.3 + 0.5 * megapixels),
            exposure_ceiling_s=facts.camera.exposure_max_s,
            sentences=(
                f"1 frame or a few to find the exposure, {more} more: {shown} spots with defocus each way",
                f"{len(VERIFIED)} frames of {(parameters.points - 1) ** 2} other spots, sent through the map's "
                "inverse, for the verification alone",
            ),
        )

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known."""
        shape = (facts.camera.height, facts.camera.width)
        return State(
            facts=facts,
            parameters=parameters,
            response_rad=response_in_force(calibration, facts, parameters.wavelength_nm),
            seed=seed,
            step=0,
            searched=0,
            guess_s=float(np.sqrt(facts.camera.exposure_min_s * facts.camera.exposure_max_s)),
            exposure_s=0.0,
            reference=None,
            pictures=np.zeros((0, *shape), np.uint16),
            exposures_s=np.zeros(0),
            grids=np.zeros(0, np.int64),
            second_tan=np.zeros((0, 2)),
            sent_tan=np.zeros((0, 2)),
            wanted_tan=np.zeros((0, 2)),
            light_values=np.zeros(0),
            rms_px=float("nan"),
            noise_px=float("nan"),
        )

    def with_camera(self, state: State, reference: Reference) -> State:
        """Return the state told of the camera: its noise, its dark level, and the light of a random pattern."""
        from procedures._distortion_map import first_guess_s

        return replace(state, reference=reference, guess_s=first_guess_s(state, reference.rate))

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the first frame, then its grid with the other defocus, then the second grid with both."""
        if state.exposure_s == 0:
            yield self._shot(state, 0, 1.0, state.step, 0, exposure_s=state.guess_s, clip_limit=1.0, keep=True)
            return
        for number, (grid, sign) in enumerate(_next(state)):
            yield self._shot(state, grid, sign, state.step, number, exposure_s=state.exposure_s)

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state with the exposure found, or with the map of all spots."""
        from procedures._distortion_map import with_first, with_map, with_second_grid

        state = replace(state, step=state.step + 1)
        if state.exposure_s == 0:
            return with_first(state, frames[0])
        state = with_frames(state, frames, [grid for grid, _ in _next(state)])
        if state.parameters.mode == "grid" and not len(state.second_tan):
            return with_second_grid(state)
        return with_map(state)

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        if not len(state.sent_tan):
            value = state.exposure_s or state.guess_s
            return {"quantity": "exposure", "value": value, "sigma": None, "target": None, "unit": "s"}
        return {
            "quantity": "distance from where sent (rms)",
            "value": state.rms_px,
            "sigma": state.noise_px,
            "target": state.parameters.target_rms_px,
            "unit": "px",
        }

    def judge(self, state: State) -> Judgement:
        """Return whether to go on: the map is made once, and verified."""
        if not len(state.sent_tan):
            found = "the first grid is seen" if len(state.second_tan) else "exposure found"
            return Judgement(Outcome.CONTINUE, "looking for the exposure" if state.exposure_s == 0 else found)
        said = f"spots are {state.rms_px:.2f} px (rms) from where they were sent, each known to {state.noise_px:.3f} px"
        return Judgement(Outcome.TARGET_MET, f"{said}: mapped, and verified with others")

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield spots that the map has not seen, sent where its inverse says, with defocus each way."""
        for number, sign in enumerate(VERIFIED):
            yield self._shot(state, 2, sign, VERIFICATION, number, exposure_s=state.exposure_s, keep=number == 0)

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result; "after" is measured on the verification's frames only."""
        from procedures._distortion_result import conclusion

        return conclusion(state, frames)

    def remeasure(
        self,
        facts: RigFacts,
        calibration: Mapping[str, Any],
        parameters: Parameters,
        reference: Reference,
        seed: int,
    ) -> Generator[Shot, Frame, Remeasured]:
        """Yield the frames that measure the accepted map; return how far its spots are from their places."""
        from procedures._distortion_check import remeasured

        state = self.with_camera(self.start(facts, calibration, parameters, seed), reference)
        return remeasured(self, state, calibration[self.name])

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return how far the simulated bench's rays are from where the verification's spots were to be seen."""
        from procedures._distortion_truth import against_truth

        return against_truth(conclusion, truth)

    def _shot(
        self,
        state: State,
        grid: int,
        sign: float,
        step: int,
        number: int,
        *,
        exposure_s: float,
        clip_limit: float = CLIP_LIMIT,
        keep: bool = False,
    ) -> Shot:
        from procedures._distortion_map import levels_of

        return Shot(
            label=f"{'verify' if grid == 2 else 'ab'[grid]}-{'plus' if sign > 0 else 'minus'}",
            levels=levels_of(state, grid, sign, (state.seed, step, number)),
            exposure_s=exposure_s,
            wavelength_m=state.parameters.wavelength_nm * 1e-9,
            clip_limit=clip_limit,
            keep=keep,
        )


def _next(state: State) -> Sequence[tuple[int, float]]:
    """Return grid and sign of the frames that come next, once the exposure is known."""
    return SECOND if len(state.second_tan) else FIRST


def with_frames(state: State, frames: Sequence[Frame], grids: Sequence[int]) -> State:
    """Return the state with frames of grids."""
    return replace(
        state,
        pictures=np.concatenate([state.pictures, *(frame.counts[None] for frame in frames)]),
        exposures_s=np.append(state.exposures_s, [frame.exposure_s for frame in frames]),
        grids=np.append(state.grids, grids),
    )
