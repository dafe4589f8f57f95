"""Mode `sweep` of the aberration: a contact sheet of one polynomial over a range of coefficients, for the eye.

Every frame shows a spot in focus in every zone, one polynomial of the pupil added, with the tilt that holds the spot
in its place. The sheet shows where each zone is sharpest, a parabola says at which coefficient. It corrects nothing.

=======  ======  =====================================================================================
step     frames  shows
=======  ======  =====================================================================================
spots    1       spots with defocus: where they are seen, how bright; again while it clips or is faint
sweep    9       the spots with -3 to 3 rad of the polynomial, from frame to frame
verify   2       the spots as they are, then each zone with its own best coefficient; fresh phases
=======  ======  =====================================================================================
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Judgement, Outcome, Plan, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures._aberration_model import CLIP_LIMIT, VERIFICATION, ModelMode
from procedures._aberration_model import State as Spots
from procedures._aberration_seen import ZoneWindows

if TYPE_CHECKING:
    from procedures.aberration import Parameters

Array = NDArray[np.float64]

TILTS = (2, 3)
WANTED_SHARE = 0.35  # of the exposure at which a perfect spot in focus would fill the camera's range 1.3 times


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps.

    `spots` holds the bench and the exposure of the first frame; `windows` is None until the spots are found.
    `coefficients_rad` (k,) were swept; `counts` (k, n, side, side) are the windows less the dark level and `usable`
    their pixels, at `exposures_s` (k,); `sharp` (k, n) how sharp the spots were; `best_rad`, `sigma_rad` and `valid`
    (n,) where each zone is sharpest, with `reasons` (n,) where that is not known.
    """

    spots: Spots
    windows: ZoneWindows | None
    coefficients_rad: Array
    counts: Array
    usable: NDArray[np.bool_]
    exposures_s: Array
    sharp: Array
    best_rad: Array
    sigma_rad: Array
    reasons: tuple[str, ...]
    step: int

    @property
    def parameters(self) -> Parameters:
        """What was chosen."""
        return self.spots.parameters

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which of the zones looked at have a sharpest coefficient, (n,)."""
        return np.array([not reason for reason in self.reasons], np.bool_)


class SweepMode:
    """Mode `sweep` of the procedure `aberration` (see `holocal.loop.procedure.Procedure`)."""

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        megapixels, frames = facts.slm.width * facts.slm.height / 1e6, 1 + parameters.sweep_steps + 2
        return Plan(
            frames=frames,
            steps=2,
            expected_seconds=4 + frames * (0.4 + 0.7 * megapixels),
            exposure_ceiling_s=facts.camera.exposure_max_s,
            sentences=(
                f"{parameters.zones} x {parameters.zones} zones, Noll {parameters.sweep_noll} from "
                f"{parameters.sweep_from_rad:g} to {parameters.sweep_to_rad:g} rad; it corrects nothing",
                "1 frame or a few of defocused spots: exposure, and where they are seen",
                f"{parameters.sweep_steps} frames, one per coefficient",
                "2 frames with fresh phases: without the polynomial, and with each zone's best coefficient",
            ),
        )

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known; refused where the zones are too near to each other."""
        from procedures._aberration_windows import window_side

        window_side(facts, parameters.zones)
        nothing = np.zeros(0)
        return State(
            spots=ModelMode().start(facts, calibration, parameters, seed),
            windows=None,
            coefficients_rad=np.linspace(parameters.sweep_from_rad, parameters.sweep_to_rad, parameters.sweep_steps),
            counts=np.zeros((0, 0, 1, 1)),
            usable=np.zeros((0, 0, 1, 1), np.bool_),
            exposures_s=nothing,
            sharp=np.zeros((0, 0)),
            best_rad=nothing,
            sigma_rad=nothing,
            reasons=(),
            step=0,
        )

    def with_camera(self, state: State, reference: Reference) -> State:
        """Return the state told of the camera: its noise, its dark level, and the light of a random pattern."""
        return replace(state, spots=ModelMode().with_camera(state.spots, reference))

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the first frame, then one per coefficient."""
        if state.windows is None:
            yield from ModelMode().stimuli(state.spots)
            return
        for number, coefficient in enumerate(state.coefficients_rad):
            added = np.full(len(state.windows.zones), coefficient)
            yield _shot(state, f"sweep-{coefficient:+.2f}", added, (state.step, number))

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state with the spots found, or with where every zone is sharpest."""
        if state.windows is None:
            from procedures._aberration_windows import zone_windows

            spots = ModelMode().update(state.spots, frames)
            found = None if spots.exposure_s == 0 else zone_windows(spots)
            return replace(state, spots=spots, windows=found, step=state.step + 1)
        from procedures._aberration_sweep_result import swept

        return swept(replace(state, step=state.step + 1), frames)

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        line = {"quantity": f"Noll {state.parameters.sweep_noll} where spots are sharpest", "unit": "rad"}
        if not state.valid.any():
            return line | {"value": None, "sigma": None, "target": None}
        best = state.best_rad[state.valid]
        return line | {
            "value": float(np.median(best)),
            "sigma": float(np.median(state.sigma_rad[state.valid])),
            "target": None,
            "zones": len(best),
        }

    def judge(self, state: State) -> Judgement:
        """Return whether the sheet is complete."""
        if state.windows is None:
            return Judgement(Outcome.CONTINUE, "looking for the exposure")
        if not len(state.reasons):
            return Judgement(Outcome.CONTINUE, "spots found")
        count, chosen = int(state.valid.sum()), state.parameters
        if not count:
            return Judgement(Outcome.STALLED, "no zone is sharpest inside the range")
        return Judgement(
            Outcome.TARGET_MET,
            f"Noll {chosen.sweep_noll}: sharpest at {np.median(state.best_rad[state.valid]):+.2f} rad (median of "
            f"{count} of {len(state.reasons)} zones)",
        )

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield the spots as they are, then each zone with its best coefficient; fresh phases."""
        assert state.windows is not None
        yield _shot(state, "verify-without", np.zeros(len(state.windows.zones)), (VERIFICATION, 0))
        best = np.where(state.valid, state.best_rad, 0.0)
        yield _shot(state, "verify-best", best, (VERIFICATION, 1))

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result: "before" without the polynomial, "after" with the best coefficients, on new frames."""
        from procedures._aberration_sweep_result import conclusion

        return conclusion(state, frames)

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return nothing: a sweep claims no wavefront."""
        return {}


def _shot(state: State, label: str, added_rad: Array, seeds: tuple[int, int]) -> Shot:
    """Return a shot of spots in focus with (n,) radians of the swept polynomial, each held in its place."""
    from procedures._aberration_light import array_of
    from procedures._aberration_spots import brighter_in_focus
    from procedures._aberration_windows import held_in_place, levels_with

    assert state.windows is not None
    chosen, camera, array = state.parameters, state.spots.facts.camera, array_of(state.spots)
    noll = (*TILTS, chosen.sweep_noll)
    wavefront = np.zeros((chosen.zones**2, len(noll)))
    wavefront[state.windows.zones] = added_rad[:, None] * held_in_place(array, state.windows.zones, chosen.sweep_noll)
    exposure_s = WANTED_SHARE * state.spots.exposure_s / brighter_in_focus(array)
    return Shot(
        label=label,
        levels=levels_with(state.spots, noll, wavefront, seeds),
        exposure_s=float(np.clip(exposure_s, camera.exposure_min_s, camera.exposure_max_s)),
        wavelength_m=chosen.wavelength_nm * 1e-9,
        clip_limit=CLIP_LIMIT,
        keep=True,
        # a polynomial hardly seen in one zone changes little from frame to frame, as do the last two
        fresh=False,
    )
