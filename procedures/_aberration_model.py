"""Mode `model` of the aberration: every zone of the field at once, from a handful of frames, and its correction.

A hologram shows a spot in each zone, with a known defocus. The picture of every spot is modelled through the levels
that were really shown (`holocal.estimate.spot_model`), the wavefront of each zone is fitted to all its pictures, and
the zones are joined over the field (`holocal.estimate.field_model`). The correction is then shown, and what it leaves
is measured on frames that no estimate has seen.

======  ===========================================================================================
frame   shows
======  ===========================================================================================
1       spots with defocus +1: where they are seen, and how bright; again while it clips or is faint
2 to 4  defocus -1, in focus, +1
5, 6    the correction, with defocus +1 and in focus: the verification
======  ===========================================================================================
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Judgement, Outcome, Plan, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures._holograms import response_in_force

if TYPE_CHECKING:
    from procedures.aberration import Parameters

Array = NDArray[np.float64]
Pictures = NDArray[np.uint16]

MEASURED = (-1.0, 0.0)  # defocus of the frames after the first
VERIFIED = (1.0, -1.0, 0.0)  # a pair tells wavefronts, the sharp one is looked at
BURST = (1.0, -1.0)  # of a further step
VERIFICATION = 1000  # the step number that seeds the verification's phases
WANTED_PEAK = 1.3  # of full scale, of a spot's brightest pixels: those that clip are left out, the others gain light
FIRST_PEAK = 0.5  # of full scale, of the first frame, whose light is only estimated
PEAK_OVER_MEAN = 2.2  # of a defocused spot; the Fresnel fringes of its pupil's edges
CLIPPED, FAINT = 0.02, 0.12  # share of the lit windows' pixels at full scale; their brightest's share of it
CLIP_LIMIT = 0.01  # share of the whole picture's pixels, above which the runner takes the frame darker
SEARCHES = 4


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps; the other modes hold one too, for the bench, the exposure, the spots.

    Of the frames taken: `pictures` (n, height, width), `exposures_s` (n,), `defocus` (n,), `gains` (n, zones) and
    `corrections_rad` (n, zones, modes) that they were shown with, `seeds` (n, 2) step and shot that drew their phases.
    `reference` is the camera as the pre-flight found it. `exposure_s` 0 means that it is still looked for, from
    `guess_s`. `coefficients_rad` (modes, terms) is the field's model, `valid` (zones,) which zones it rests on;
    `expected_rad` the median over zones of what is believed to be left after its correction.
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
    defocus: Array
    gains: Array
    corrections_rad: Array
    seeds: NDArray[np.int64]
    next_gain: Array
    coefficients_rad: Array
    valid: NDArray[np.bool_]
    expected_rad: float
    wavefront_rad: float


class ModelMode:
    """Mode `model` of the procedure `aberration` (see `holocal.loop.procedure.Procedure`)."""

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        megapixels = facts.slm.width * facts.slm.height / 1e6
        frames = 1 + len(MEASURED) + len(VERIFIED)
        return Plan(
            frames=frames,
            steps=2,
            expected_seconds=4 + frames * (0.5 + 0.7 * megapixels) + 0.5 * parameters.zones**2,
            exposure_ceiling_s=facts.camera.exposure_max_s,
            sentences=(
                f"{parameters.zones} x {parameters.zones} zones, Noll 4 to {parameters.noll_max}",
                "1 frame or a few of defocused spots: exposure, and where they are seen",
                f"{len(MEASURED)} frames with other defocus; {len(BURST)} more for each further step, if one is needed",
                f"{len(VERIFIED)} frames of the corrected spots, for the verification alone",
            ),
        )

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known."""
        zones, modes = parameters.zones**2, len(parameters.noll)
        shape = (facts.camera.height, facts.camera.width)
        return State(
            facts=facts,
            parameters=parameters,
            response_rad=response_in_force(calibration, facts, parameters.wavelength_nm),
            seed=seed,
            step=0,
            searched=0,
            guess_s=0.0,
            exposure_s=0.0,
            reference=None,
            pictures=np.zeros((0, *shape), np.uint16),
            exposures_s=np.zeros(0),
            defocus=np.zeros(0),
            gains=np.zeros((0, zones)),
            corrections_rad=np.zeros((0, zones, modes)),
            seeds=np.zeros((0, 2), np.int64),
            next_gain=np.ones(zones),
            coefficients_rad=np.zeros((modes, 0)),
            valid=np.zeros(zones, np.bool_),
            expected_rad=float("nan"),
            wavefront_rad=float("nan"),
        )

    def with_camera(self, state: State, reference: Reference) -> State:
        """Return the state told of the camera: its noise, its dark level, and the light of a random pattern."""
        from procedures._aberration_light import told

        return told(state, reference)

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the first frame, then those of other defocus, then corrected ones."""
        from procedures._aberration_light import shot_exposure_s

        if state.exposure_s == 0:
            yield self._shot(state, "spots", 1.0, 0, exposure_s=state.guess_s)
            return
        kinds = MEASURED if len(state.pictures) == 1 else BURST
        for number, defocus in enumerate(kinds):
            label = "focus" if defocus == 0 else "defocus-plus" if defocus > 0 else "defocus-minus"
            exposure_s = shot_exposure_s(state, defocus)
            yield self._shot(state, label, defocus, number, exposure_s=exposure_s, keep=defocus == 0)

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state with the exposure found, or with the estimate from all frames."""
        from procedures._aberration_light import with_first
        from procedures._aberration_result import estimated

        if state.exposure_s == 0:
            return with_first(state, frames[0])
        kinds = MEASURED if len(state.pictures) == 1 else BURST
        for number, (defocus, frame) in enumerate(zip(kinds, frames, strict=True)):
            state = taken(state, frame, defocus, (state.step, number))
        return estimated(replace(state, step=state.step + 1))

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        if np.isnan(state.wavefront_rad):
            value = state.exposure_s or state.guess_s
            return {"quantity": "exposure", "value": value, "sigma": None, "target": None, "unit": "s"}
        return {
            "quantity": "expected residual (rms, median zone)",
            "value": state.expected_rad,
            "sigma": None,
            "target": state.parameters.target_median_rad,
            "unit": "rad",
            "wavefront_rad": state.wavefront_rad,
            "zones": int(state.valid.sum()),
            "frames": len(state.pictures),
        }

    def judge(self, state: State) -> Judgement:
        """Return whether another burst of frames pays."""
        if np.isnan(state.wavefront_rad):
            looking = "looking for the exposure" if state.exposure_s == 0 else "exposure found"
            return Judgement(Outcome.CONTINUE, looking)
        zones, target = int(state.valid.sum()), state.parameters.target_median_rad
        said = (
            f"wavefront {state.wavefront_rad:.3f} rad (rms, median of {zones} zones), known to {state.expected_rad:.3f}"
        )
        if zones and state.expected_rad <= target:
            return Judgement(Outcome.TARGET_MET, f"{said}: corrected, and verified on fresh frames")
        if state.step >= state.parameters.max_steps:
            return Judgement(Outcome.OUT_OF_STEPS, f"{said}: after as many steps as were allowed")
        return Judgement(Outcome.CONTINUE, f"{said}, target {target:g}: {len(BURST)} corrected frames more")

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield the corrected spots, fresh phases, with and without defocus."""
        from procedures._aberration_light import shot_exposure_s

        final = replace(state, step=VERIFICATION)
        for number, defocus in enumerate(VERIFIED):
            exposure_s = shot_exposure_s(state, defocus)
            yield self._shot(final, "verify", defocus, number, exposure_s=exposure_s, keep=True)

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result; "after" is measured on the verification's frames only."""
        from procedures._aberration_result import conclusion

        return conclusion(state, verified(state, frames))

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the correction leaves of the simulated bench's exact phase."""
        from procedures._aberration_truth import residual_of

        return residual_of(conclusion, truth)

    def _shot(
        self, state: State, label: str, defocus: float, number: int, *, exposure_s: float, keep: bool = False
    ) -> Shot:
        from procedures._aberration_light import levels_of, recipe_of

        chosen = state.parameters
        recipe = recipe_of(state, defocus, (state.step, number))
        return Shot(
            label=label,
            levels=levels_of(state, recipe),
            exposure_s=exposure_s,
            wavelength_m=chosen.wavelength_nm * 1e-9,
            clip_limit=CLIP_LIMIT,
            keep=keep,
        )


def taken(state: State, frame: Frame, defocus: float, seeds: tuple[int, int]) -> State:
    """Return the state with a frame and what it was shown with."""
    from procedures._aberration_light import correction_of

    return replace(
        state,
        pictures=np.concatenate([state.pictures, frame.counts[None]]),
        exposures_s=np.append(state.exposures_s, frame.exposure_s),
        defocus=np.append(state.defocus, defocus),
        gains=np.concatenate([state.gains, state.next_gain[None]]),
        corrections_rad=np.concatenate([state.corrections_rad, correction_of(state)[None]]),
        seeds=np.concatenate([state.seeds, np.array([seeds], np.int64)]),
    )


def verified(state: State, frames: Sequence[Frame]) -> State:
    """Return a state that holds the verification's frames and no others."""
    fresh = replace(
        state,
        step=VERIFICATION,
        pictures=state.pictures[:0],
        exposures_s=np.zeros(0),
        defocus=np.zeros(0),
        gains=state.gains[:0],
        corrections_rad=state.corrections_rad[:0],
        seeds=state.seeds[:0],
    )
    for number, (defocus, frame) in enumerate(zip(VERIFIED, frames, strict=True)):
        fresh = taken(fresh, frame, defocus, (VERIFICATION, number))
    return fresh
