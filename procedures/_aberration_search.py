"""Mode `search` of the aberration: the wavefront of every zone without a model of the bench, from mirrored pictures.

The classical loop for benches whose model is not trusted: each zone tries its own Zernike coefficients in every frame
(`holocal.estimate.model_free`). The zones that succeed are joined over the field, and that correction is verified.

=========  ======  =======================================================================================
step       frames  shows
=========  ======  =======================================================================================
spots      1       spots with defocus: where they are seen, how bright; again while it clips or is faint
before     1       spots in focus
centre     2       opposite biases: steers every spot to its window's middle
push       26      opposite biases as it is, and with each of 12 modes pushed
refine     2 each  three pairs, a solve each; then another push, and a third while a zone still moves
average    2 each  six pairs, their solves averaged
after      1       each zone with what it found, in focus: must be sharper than before
verify     5       the field's correction, fresh phases: two pairs that measure what is left, then in focus
=========  ======  =======================================================================================

86 frames where two pushes are enough, 118 with three; fewer where zones see fewer than 12 modes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.model_free_state import (
    AFTER,
    AVERAGE,
    BEFORE,
    CENTRE,
    DONE,
    PUSH,
    REFINE,
    SearchPlan,
    SearchState,
    search_plan,
    start,
)
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

WANTED_PEAK = 0.6  # of full scale: saturated pixels say nothing here
STEADY = (0.3, 3.0)  # by how much an exposure changes from step to step at most
VERIFIED_PAIRS = 2
# The pictures at opposite biases are mirrored as far as the pupil is where the panel's image is. It is an eye relief
# away: what its rim cuts, and how the light's way depends on its direction, is no mirror image, by the square of the
# bias. Measured, one run each of 9 zones, their own residual: 5 px 0.045 rad (median), 3.5 0.037, 2.5 0.023, 1.8 0.021.
SPREAD_PX = 1.8  # of a biased spot, rms along each axis
# A bench out of line has coefficients of 10 rad over a whole pupil of which a zone shows a tenth: what is hardly seen
# counts. Measured at 5 px: at 0.02 the zones keep 0.054 rad, at 0.005 0.045, with 18 frames a push instead of 14.
DROPPED_RAD = 0.005
# With so small a bias the answers to a push change with the aberration: those of the first push are too far away.
# Measured on a bench that is 2 mm off: 4 of 9 zones found after one push, 9 after two.
LEAST_PASSES = 2
NAMES = {
    BEFORE: "before",
    CENTRE: "centred",
    PUSH: "pushed",
    REFINE: "refined",
    AVERAGE: "averaged",
    AFTER: "after",
    DONE: "done",
}


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps.

    `spots` holds the bench, the exposure of the first frame and, in the end, the field's model; `windows`, `plan` and
    `search` are None until the spots are found. `focus` (n, height, width) are the pictures in focus before and after,
    taken at `focus_s` (n,); `next_focus_s` and `biased_s` are the exposures of the next frames; `taken_s` (n,) those of
    all frames of the search; `last` is the stage whose frames came last.
    """

    spots: Spots
    windows: ZoneWindows | None
    plan: SearchPlan | None
    search: SearchState | None
    focus: NDArray[np.uint16]
    focus_s: Array
    next_focus_s: float
    biased_s: float
    taken_s: Array
    step: int
    last: str

    @property
    def parameters(self) -> Parameters:
        """What was chosen."""
        return self.spots.parameters


class SearchMode:
    """Mode `search` of the procedure `aberration` (see `holocal.loop.procedure.Procedure`)."""

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing; with two pushes, where as many as allowed take more."""
        passes = min(LEAST_PASSES, parameters.search_passes), parameters.search_passes
        least, most = (self._frames(len(parameters.noll), n) for n in passes)
        megapixels = facts.slm.width * facts.slm.height / 1e6
        return Plan(
            frames=least,
            steps=18,
            expected_seconds=4 + least * (0.4 + 0.7 * megapixels) + 0.3 * parameters.zones**2,
            exposure_ceiling_s=facts.camera.exposure_max_s,
            sentences=(
                f"{parameters.zones} x {parameters.zones} zones, Noll 4 to {parameters.noll_max}, without a model",
                "1 frame or a few of defocused spots: exposure, and where they are seen",
                f"{least - 1 - 1 - 2 * VERIFIED_PAIRS} frames of trials; up to {most - least} more while a zone moves",
                f"{1 + 2 * VERIFIED_PAIRS} frames of the corrected spots, for the verification alone",
            ),
        )

    @staticmethod
    def _frames(modes: int, passes: int) -> int:
        """Return the frames of a run whose zones all see so many modes."""
        return 1 + 4 + passes * (2 * (1 + modes) + 6) + 12 + 1 + 2 * VERIFIED_PAIRS

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known; refused where the zones are too near to each other."""
        from procedures._aberration_windows import window_side

        window_side(facts, parameters.zones)
        spots = ModelMode().start(facts, calibration, parameters, seed)
        return State(
            spots=spots,
            windows=None,
            plan=None,
            search=None,
            focus=spots.pictures,
            focus_s=np.zeros(0),
            next_focus_s=0.0,
            biased_s=0.0,
            taken_s=np.zeros(0),
            step=0,
            last="spots",
        )

    def with_camera(self, state: State, reference: Reference) -> State:
        """Return the state told of the camera: its noise, its dark level, and the light of a random pattern."""
        return replace(state, spots=ModelMode().with_camera(state.spots, reference))

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the first frame, then those of the search's next stage that depend on no picture of each other."""
        from holocal.estimate.model_free import trial

        if state.search is None or state.plan is None:
            yield from ModelMode().stimuli(state.spots)
            return
        search, plan = state.search, state.plan
        for shot in range(_frames_of(plan, search)):
            asked = trial(plan, replace(search, step=search.step + shot))
            yield self._shot(state, asked, _label(search, shot), (state.step, shot))

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state with the spots found, or after a stage of the search."""
        if state.search is None:
            spots = ModelMode().update(state.spots, frames)
            state = replace(state, spots=spots, step=state.step + 1)
            return state if spots.exposure_s == 0 else _begun(state)
        return _advanced(replace(state, step=state.step + 1, last=state.search.stage), frames)

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        target = state.parameters.target_median_rad
        line = {"quantity": "wavefront left as expected, rad rms", "target": target, "unit": "rad", "stage": state.last}
        if state.search is None or state.search.passes == 0:
            return line | {"value": None, "sigma": None}
        expected, zones = expected_rad(state)
        scatter = float(np.std(zones)) if len(zones) else 0.0
        moved = state.search.moved_rad[np.isfinite(state.search.moved_rad)]
        step = float(np.median(moved)) if len(moved) else None
        return line | {
            "value": expected,
            "sigma": scatter,
            "last_step_rad": step,
            "zones": len(zones),
            "passes": state.search.passes,
            "frames": state.search.frames,
        }

    def judge(self, state: State) -> Judgement:
        """Return whether the search is done, and what its last stage was."""
        search = state.search
        if search is None or search.stage == BEFORE:
            return Judgement(Outcome.CONTINUE, "looking for the exposure" if search is None else "spots found")
        expected, zones = expected_rad(state)
        said = f"{NAMES[state.last]}: {search.frames} frames"
        if search.passes:
            said += f", {expected:.3f} rad expected to be left (rms, median of {len(zones)} zones)"
        if not search.done:
            return Judgement(Outcome.CONTINUE, f"{said}; next: {search.stage}")
        valid = int(state.spots.valid.sum())
        if valid and expected <= state.parameters.target_median_rad:
            return Judgement(Outcome.TARGET_MET, f"{said}; {valid} zones found")
        return Judgement(Outcome.STALLED, f"{said}; {valid} zones found")

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield the field's correction at opposite biases, then in focus; fresh phases."""
        from procedures._aberration_search_result import verified_trial

        for shot in range(2 * VERIFIED_PAIRS):
            sign = 1 - 2 * (shot % 2)
            yield self._shot(state, verified_trial(state, sign), "verify-bias", (VERIFICATION, shot))
        yield self._shot(state, verified_trial(state, 0), "verify", (VERIFICATION, 2 * VERIFIED_PAIRS))

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result; "after" is measured on the verification's frames only."""
        from procedures._aberration_search_result import conclusion

        return conclusion(state, frames)

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the field's correction, and each zone's own, leave of the simulated bench's exact phase."""
        from procedures._aberration_search_result import own_residual_of

        return own_residual_of(conclusion, truth)

    def _shot(self, state: State, asked_rad: Array, label: str, seeds: tuple[int, int]) -> Shot:
        """Return a shot of the searched zones' trial (n, trial modes)."""
        from procedures._aberration_windows import levels_with

        assert state.plan is not None
        assert state.windows is not None
        wavefront = np.zeros((state.parameters.zones**2, len(state.plan.trial_noll)))
        wavefront[state.windows.zones] = asked_rad
        in_focus = label in (BEFORE, AFTER, "verify")
        return Shot(
            label=label,
            levels=levels_with(state.spots, state.plan.trial_noll, wavefront, seeds),
            exposure_s=state.next_focus_s if in_focus else state.biased_s,
            wavelength_m=state.parameters.wavelength_nm * 1e-9,
            clip_limit=CLIP_LIMIT,
            keep=in_focus,
        )


def _frames_of(plan: SearchPlan, search: SearchState) -> int:
    """Return how many frames the next step takes: those whose trials are known by now."""
    if search.stage in (BEFORE, AFTER):
        return 1
    return 2 * (1 + plan.modes.shape[1]) if search.stage == PUSH else 2


def _label(search: SearchState, shot: int) -> str:
    if search.stage in (BEFORE, AFTER):
        return search.stage
    return f"{search.stage}-{'minus' if shot % 2 else 'plus'}"


def _begun(state: State) -> State:
    """Return the state with windows round the spots that were found, and the search's plan."""
    from procedures._aberration_light import array_of, shot_exposure_s
    from procedures._aberration_windows import lit_pupils, zone_windows

    chosen, windows = state.parameters, zone_windows(state.spots)
    plan = search_plan(
        lit_pupils(array_of(state.spots), windows.zones),
        chosen.noll,
        px_per_gradient=windows.px_per_gradient,
        spread_px=SPREAD_PX,
        dropped_rad=DROPPED_RAD,
        passes=chosen.search_passes,
    )
    return replace(
        state,
        windows=windows,
        plan=plan,
        search=start(plan, window=(windows.side, windows.side)),
        next_focus_s=0.5 * shot_exposure_s(state.spots, 0.0),
        biased_s=0.5 * state.spots.exposure_s,
    )


def _advanced(state: State, frames: tuple[Frame, ...]) -> State:
    """Return the state after a stage's frames."""
    from holocal.estimate.mirrored_pictures import Noise
    from holocal.estimate.model_free import take
    from procedures._aberration_search_result import joined
    from procedures._aberration_windows import cut, noise_of

    search, plan, windows = state.search, state.plan, state.windows
    assert search is not None
    assert plan is not None
    assert windows is not None
    full, noise = state.spots.facts.camera.full_scale, Noise(*noise_of(state.spots))
    pictures = [cut(state.spots, windows, frame) for frame in frames]
    for counts, usable in pictures:
        search = take(plan, search, counts, usable, full_scale=full, noise=noise)
    if search.stage == AVERAGE and state.last == REFINE and search.passes < min(LEAST_PASSES, plan.passes):
        search = replace(search, stage=PUSH, step=0)
    state = replace(state, search=search, taken_s=np.append(state.taken_s, [frame.exposure_s for frame in frames]))
    state = _exposed(state, frames, pictures)
    return joined(state) if search.done else state


def _exposed(state: State, frames: tuple[Frame, ...], pictures: list[tuple[Array, NDArray[np.bool_]]]) -> State:
    """Return the state with the next exposures, by how bright the last frames were."""
    from procedures._aberration_light import array_of
    from procedures._aberration_windows import brightest, lit_pupils, sharpness

    camera, windows = state.spots.facts.camera, state.windows
    assert windows is not None
    if state.last not in (BEFORE, AFTER):
        peak = max(float(brightest(state.spots, *part, pixels=9).max()) for part in pictures)
        asked = frames[0].exposure_s * float(np.clip(WANTED_PEAK / max(peak, 1e-3), *STEADY))
        return replace(state, biased_s=float(np.clip(asked, camera.exposure_min_s, camera.exposure_max_s)))
    state = replace(
        state,
        focus=np.concatenate([state.focus, frames[0].counts[None]]),
        focus_s=np.append(state.focus_s, frames[0].exposure_s),
    )
    lit = lit_pupils(array_of(state.spots), windows.zones)
    sharp = np.nan_to_num(sharpness(state.spots, windows, *pictures[0], lit), nan=1.0)
    # a spot that is corrected is brighter by what its sharpness lacks
    peak = float(np.max(brightest(state.spots, *pictures[0], pixels=1) / np.clip(sharp, 0.1, 1.0)))
    asked = frames[0].exposure_s * float(np.clip(WANTED_PEAK / max(peak, 1e-3), 0.1 * STEADY[0], STEADY[1]))
    return replace(state, next_focus_s=float(np.clip(asked, camera.exposure_min_s, camera.exposure_max_s)))


def expected_rad(state: State) -> tuple[float, Array]:
    """Return what is expected to be left, the median over the zones that have light, and those zones' numbers."""
    from holocal.estimate.model_free import result

    assert state.search is not None
    assert state.plan is not None
    found = result(state.plan, state.search)
    counted = found.valid if state.search.done else ~state.search.dark & state.plan.seen.any(axis=1)
    left = found.residual_sigma_rad[counted]
    return (float(np.median(left)) if len(left) else float("nan")), left
