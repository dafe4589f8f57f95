"""The aberration of every zone without a model of the bench: opposite biases and mirrored pictures.

Every frame shows one spot per zone, each with its own trial of Zernike coefficients. Two frames at opposite large
quadratic biases are each other's mirror when the aberration is corrected (`mirrored_pictures`); pushing each visible
mode once at both biases tells how the difference answers to it; a linear solve says what is wrong. With N modes one
such pass takes 2 N + 2 frames, after which every further pair of frames is a new measurement of what is left.

=======  =====================================================================================
before   1 frame without bias: which zones have light, where the spot is, how sharp it is
centre   1 pair: steers the spot's centre of symmetry to the window's centre
push     1 pair as it is, 1 pair per mode; a first solve
refine   3 pairs, one solve each; then another push while a zone still moves, 3 in all at most
average  6 pairs, their solves averaged
after    1 frame without bias, to hold against the first
=======  =====================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from holocal.errors import UsageError
from holocal.estimate.lit_pupil import QUADRATIC, LitPupil, mean_gradient, spreading_bias, visible_modes
from holocal.estimate.mirrored_pictures import (
    SATURATED,
    Mask,
    Noise,
    Pair,
    centroid_px,
    has_light,
    mirrored_pair,
    share_within,
    solve_step,
)

Array = NDArray[np.float64]

BEFORE, CENTRE, PUSH, REFINE, AVERAGE, AFTER, DONE = "before", "centre", "push", "refine", "average", "after", "done"
TILT = (2, 3)
PUSH_RAD = 1.0  # rms over the lit part
LARGEST_PUSH_RAD = 15.0  # of any one coefficient: a combination that is hardly seen would need hundreds
STEEPEST = 600.0  # rad per radius squared: a strip 0.1 radius high is spread by 17 rad per radius, 1.6 pixels
COARSE_PX, FINE_PX = 3.0, 0.7  # smoothing of pictures; measured: at 3 px, 4 rad is found, at 1.5 px it often is not
COARSE_PER_RAD = 5.0  # px of smoothing per rad of the last step
STILL_RAD = 0.15  # a step above it asks for a new push: the answers were measured too far away
LARGEST_SIGMA_RAD = 0.15
LARGEST_FALL = 0.15  # of the share of light in the spot's brightest 3 x 3 pixels


@dataclass(frozen=True)
class SearchPlan:
    """What is tried, zone by zone; made once by `search_plan`.

    `trial_noll` are the indices of a trial's columns: tilt, the biases' 4 to 6, and those searched. `modes`
    (zones, modes, len(noll)) are the visible combinations, rows of zeros where a zone has fewer; `length` (zones,
    modes) how long each is in Noll terms; `dropped` (zones,) the effect of the
    others, per rad of each; `bias` and `untilt` (zones, len(trial_noll)) and (zones, 2, ...) the
    bias, and the tilts that hold the spot's centroid in place; `gradient_per_px` (2, 2) what moves the spot.
    """

    noll: tuple[int, ...]
    trial_noll: tuple[int, ...]
    modes: Array
    length: Array
    dropped: Array
    bias: Array
    untilt: Array
    gradient_per_px: Array
    prior_rad: float
    passes: int
    refinements: int
    averages: int

    @property
    def zones(self) -> int:
        """How many zones there are."""
        return len(self.modes)

    @property
    def seen(self) -> Mask:
        """(zones, modes) which combinations there are."""
        return np.asarray(self.length > 0)

    def frames(self, passes: int) -> int:
        """Return how many frames a search of that many passes takes."""
        each = 2 * (1 + self.modes.shape[1]) + 2 * self.refinements
        return 4 + passes * each + 2 * self.averages

    @property
    def largest_rad(self) -> float:
        """The largest coefficient, tilt left out, that a trial adds to what was found."""
        pushes = np.abs(self.modes * _push_sizes(self)[:, :, None])
        return float(np.abs(self.bias[:, 2:]).max(initial=0.0) + pushes.max(initial=0.0))


@dataclass(frozen=True)
class SearchState:
    """Where a search stands: made by `start`, moved on by `take`; arrays, numbers, strings and bools only.

    `stage` and `step` say which frame is next. `modes_rad` (zones, modes) and `tilt_rad` (zones, 2) are the correction
    so far; `covariance` (zones, modes, modes) its error; `slopes` (zones, modes, h, w) the answers of the difference;
    `plain` (zones, h, w) the difference that was not pushed; `waiting` and `waiting_usable` the first picture of a
    pair; `tries_rad` (zones, averages, modes) the corrections that are averaged.
    """

    stage: str
    step: int
    passes: int
    frames: int
    modes_rad: Array
    tilt_rad: Array
    covariance: Array
    moved_rad: Array
    misfit: Array
    slopes: NDArray[np.float32]
    plain: Array
    waiting: Array
    waiting_usable: Mask
    tries_rad: Array
    dark: Mask
    share_before: Array
    share_after: Array

    @property
    def done(self) -> bool:
        """Whether no frame is wanted any more."""
        return self.stage == DONE


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    `correction_rad` (zones, len(noll)) is what to add to the holograms, `aberration_rad` its opposite; `sigma_rad`
    the standard error of each coefficient, with the prior's share for what the lit part does not show;
    `residual_sigma_rad` (zones,) the error expected of the wavefront, rms over the lit part; `sentences` one per zone
    that did not work, in order.
    """

    correction_rad: Array
    sigma_rad: Array
    residual_sigma_rad: Array
    valid: Mask
    sentences: tuple[str, ...]

    @property
    def aberration_rad(self) -> Array:
        """What was found to be wrong: the correction's opposite."""
        return -self.correction_rad


def search_plan(
    lit: Sequence[LitPupil],
    noll: tuple[int, ...] = tuple(range(4, 16)),
    *,
    px_per_gradient: Array,
    spread_px: float = 5.0,
    prior_rad: float = 2.0,
    dropped_rad: float = 0.02,
    passes: int = 3,
    refinements: int = 3,
    averages: int = 6,
) -> SearchPlan:
    """Return the plan of a search.

    Parameters
    ----------
    lit
        The lit part of each zone's pupil, as it is expected.
    noll
        What is searched, from 4 upwards.
    px_per_gradient
        (2, 2) by how many columns and rows a gradient of 1 rad per pupil radius along x and y moves the spot; it
        steers spots and sizes biases only, some 10 % is good enough.
    spread_px
        Size of a biased spot, rms along each axis. A window of 41 pixels holds 5 with 4 rad of aberration on top.
    prior_rad
        How large each coefficient may be, as a standard deviation.
    dropped_rad
        Combinations that change the wavefront by less, per rad of coefficients, are left alone.
    """
    if len(set(noll)) != len(noll) or not noll or min(noll) < 4:
        raise UsageError(f"A search of Noll indices {noll} is none.", fix="Name each once, from 4 upwards.")
    if not lit:
        raise UsageError("A search needs at least one zone.")
    trial_noll = (*TILT, *sorted({*QUADRATIC, *noll}))
    gradient_per_px = np.linalg.inv(np.asarray(px_per_gradient, np.float64))
    found = [visible_modes(part, noll, dropped_rad=dropped_rad) for part in lit]
    count = max(1, max(len(combinations) for combinations, _, _ in found))
    modes, length = np.zeros((len(lit), count, len(noll))), np.zeros((len(lit), count))
    bias, untilt = np.zeros((len(lit), len(trial_noll))), np.zeros((len(lit), 2, len(trial_noll)))
    places = [trial_noll.index(j) for j in QUADRATIC]
    gradient_rad = spread_px * float(np.sqrt(np.abs(np.linalg.det(gradient_per_px))))
    for zone, (part, (combinations, sizes, _)) in enumerate(zip(lit, found, strict=True)):
        modes[zone, : len(sizes)], length[zone, : len(sizes)] = combinations, sizes
        bias[zone, places] = spreading_bias(part, gradient_rad=gradient_rad, steepest=STEEPEST)
        untilt[zone, :, 2:] = -mean_gradient(part, trial_noll[2:]) / 2  # Noll 2 is 2 x, 3 is 2 y
    return SearchPlan(
        noll=noll,
        trial_noll=trial_noll,
        modes=modes,
        length=length,
        dropped=np.array([left for _, _, left in found]),
        bias=bias,
        untilt=untilt,
        gradient_per_px=gradient_per_px,
        prior_rad=prior_rad,
        passes=passes,
        refinements=refinements,
        averages=averages,
    )


def start(plan: SearchPlan, *, window: tuple[int, int] = (41, 41)) -> SearchState:
    """Return the state before the first frame, for windows of that many rows and columns."""
    zones, count = plan.length.shape
    return SearchState(
        stage=BEFORE,
        step=0,
        passes=0,
        frames=0,
        modes_rad=np.zeros((zones, count)),
        tilt_rad=np.zeros((zones, 2)),
        covariance=np.stack([np.diag(row) for row in _prior(plan) ** 2]),
        moved_rad=np.full(zones, np.inf),
        misfit=np.full(zones, np.inf),
        slopes=np.zeros((zones, count, *window), np.float32),
        plain=np.zeros((zones, *window)),
        waiting=np.zeros((zones, *window)),
        waiting_usable=np.zeros((zones, *window), bool),
        tries_rad=np.zeros((zones, plan.averages, count)),
        dark=np.zeros(zones, bool),
        share_before=np.zeros(zones),
        share_after=np.zeros(zones),
    )


def frames_planned(plan: SearchPlan, state: SearchState) -> int:
    """Return how many frames the search takes in all if no zone asks for another pass."""
    return state.frames if state.done else plan.frames(max(1, state.passes))


def trial(plan: SearchPlan, state: SearchState) -> Array:
    """Return (zones, len(plan.trial_noll)) rad to add to the zones' holograms in the next frame."""
    asked = np.zeros((plan.zones, len(plan.trial_noll)))
    modes = state.modes_rad.copy()
    if state.stage == PUSH and state.step >= 2:
        mode = state.step // 2 - 1
        modes[:, mode] += _push_sizes(plan)[:, mode]
    asked[:, _columns(plan)] = np.einsum("zm,zmj->zj", modes, plan.modes)
    if state.stage in (CENTRE, PUSH, REFINE, AVERAGE):
        asked += plan.bias * (1 - 2 * (state.step % 2))
    asked[:, :2] = np.einsum("zcj,zj->zc", plan.untilt, asked) + state.tilt_rad
    return asked


def take(
    plan: SearchPlan, state: SearchState, windows: Array, usable: Mask, *, full_scale: float, noise: Noise
) -> SearchState:
    """Return the state after a frame.

    Parameters
    ----------
    windows
        (zones, h, w) counts, the dark level subtracted, around each zone's place.
    usable
        Pixels that are neither hot nor dead; saturated ones are left out here.
    full_scale
        Counts at which the camera saturates.
    """
    if state.done:
        raise UsageError("The search is done; it takes no more frames.")
    if windows.shape != state.plain.shape or usable.shape != windows.shape:
        raise UsageError(f"The windows are {windows.shape}, their mask {usable.shape}; both are {state.plain.shape}.")
    windows = np.asarray(windows, np.float64)
    usable = usable & (windows < SATURATED * full_scale)
    state = replace(state, frames=state.frames + 1)
    if state.stage in (BEFORE, AFTER):
        return _unbiased(plan, state, windows, usable, noise)
    if state.step % 2 == 0:
        return replace(state, step=state.step + 1, waiting=windows, waiting_usable=usable)
    pair = mirrored_pair(state.waiting, state.waiting_usable, windows, usable, noise)
    state = replace(state, dark=state.dark | ~pair.lit)
    if state.stage == CENTRE:
        places = centroid_px(state.waiting, state.waiting_usable) + centroid_px(windows, usable)
        return replace(_steered(plan, state, places / 2), stage=PUSH, step=0)
    if state.stage == PUSH:
        return _pushed(plan, state, pair)
    return _corrected(plan, state, pair)


def result(plan: SearchPlan, state: SearchState) -> SearchResult:
    """Return what the search has found so far; before it is done no zone is valid."""
    correction = np.einsum("zm,zmj->zj", state.modes_rad, plan.modes)
    # what the lit part does not show is taken to be as large as what it shows, direction by direction in Noll terms
    usual = np.linalg.norm(correction, axis=1) / np.sqrt(np.maximum(plan.seen.sum(axis=1), 1))
    usual = np.where(state.dark | (usual == 0), plan.prior_rad, np.minimum(usual, plan.prior_rad))
    hidden = np.maximum(1 - np.einsum("zmj,zm->zj", plan.modes**2, _inverse(plan.length) ** 2), 0.0)
    seen = np.einsum("zmj,zmn,znj->zj", plan.modes, state.covariance, plan.modes)
    sigma = np.sqrt(np.maximum(seen, 0.0) + usual[:, None] ** 2 * hidden)
    residual = np.sqrt(np.einsum("zmm->z", state.covariance) + (usual * plan.dropped) ** 2)
    reasons = [_reason(plan, state, zone, float(residual[zone])) for zone in range(plan.zones)]
    return SearchResult(
        correction,
        sigma,
        residual,
        np.array([state.done and not reason for reason in reasons], bool),
        tuple(f"Zone {zone}: {reason}" for zone, reason in enumerate(reasons) if reason),
    )


def _reason(plan: SearchPlan, state: SearchState, zone: int, sigma_rad: float) -> str:
    """Return why a zone did not work, empty where it did."""
    if state.dark[zone]:
        return f"no light that stands out of the noise (by frame {state.frames}); nothing was corrected."
    if not plan.seen[zone].any():
        return "none of the modes changes the wavefront over its lit part; nothing was corrected."
    if state.stage not in (AFTER, DONE):
        return ""
    if sigma_rad > LARGEST_SIGMA_RAD or state.moved_rad[zone] > 2 * STILL_RAD:
        return (
            f"the search did not settle: last step {state.moved_rad[zone]:.2f} rad, error {sigma_rad:.2f} rad, limits "
            f"{2 * STILL_RAD:g} and {LARGEST_SIGMA_RAD:g}; start from a neighbour's correction or with fewer modes."
        )
    fall = state.share_before[zone] - state.share_after[zone]
    if state.done and fall > LARGEST_FALL:
        return (
            f"the spot did not get sharper: {state.share_after[zone]:.2f} of its light within 3 x 3 pixels, "
            f"{state.share_before[zone]:.2f} before; search again from zero."
        )
    return ""


def _unbiased(plan: SearchPlan, state: SearchState, windows: Array, usable: Mask, noise: Noise) -> SearchState:
    share = share_within(windows, usable)
    if state.stage == AFTER:
        return replace(state, stage=DONE, share_after=share)
    state = replace(state, dark=~has_light(windows, usable, noise), share_before=share)
    return replace(_steered(plan, state, centroid_px(windows, usable)), stage=CENTRE, step=0)


def _steered(plan: SearchPlan, state: SearchState, shift_px: Array) -> SearchState:
    """Return the state with spots moved back by `shift_px` (zones, 2); dark zones stay."""
    moved = np.where(state.dark[:, None], 0.0, shift_px) @ plan.gradient_per_px.T / 2
    return replace(state, tilt_rad=state.tilt_rad - moved)


def _pushed(plan: SearchPlan, state: SearchState, pair: Pair) -> SearchState:
    """Return the state after a pair of a pass: the plain one, then one per mode; the last one solves."""
    mode = state.step // 2 - 1
    if mode < 0:
        return replace(state, step=state.step + 1, plain=pair.difference)
    size = np.where(plan.seen[:, mode], _push_sizes(plan)[:, mode], 1.0)[:, None, None]
    slopes = state.slopes.copy()
    slopes[:, mode] = (pair.difference - state.plain) / size
    state = replace(state, step=state.step + 1, slopes=slopes)
    if mode + 1 < plan.modes.shape[1]:
        return state
    blur = np.where(state.passes == 0, COARSE_PX, _blurs(state))
    state = _solved(plan, state, replace(pair, difference=state.plain), blur, 1.0)
    return replace(state, stage=REFINE, step=0, passes=state.passes + 1)


def _corrected(plan: SearchPlan, state: SearchState, pair: Pair) -> SearchState:
    """Return the state after a pair of a refinement or an average."""
    number = state.step // 2 + 1
    if state.stage == REFINE:
        state = replace(_solved(plan, state, pair, _blurs(state), 1.0), step=state.step + 1)
        if number < plan.refinements:
            return state
        moving = (state.moved_rad > STILL_RAD) & ~state.dark & plan.seen.any(axis=1)
        again = bool(moving.any()) and state.passes < plan.passes
        return replace(state, stage=PUSH if again else AVERAGE, step=0)
    state = _solved(plan, state, pair, _blurs(state), 1.0 / number)
    if number < plan.averages:
        return replace(state, step=state.step + 1)
    return replace(_averaged(plan, state), stage=AFTER, step=0)


def _solved(plan: SearchPlan, state: SearchState, pair: Pair, blur_px: Array, gain: float) -> SearchState:
    """Return the state with what is wrong taken back, a share `gain` of it."""
    modes, covariance, tries = state.modes_rad.copy(), state.covariance.copy(), state.tries_rad.copy()
    moved, misfit, shifts = state.moved_rad.copy(), state.misfit.copy(), np.zeros((plan.zones, 2))
    for zone in np.flatnonzero(~state.dark & plan.seen.any(axis=1)):
        count = int(plan.seen[zone].sum())
        step = solve_step(
            pair,
            int(zone),
            np.asarray(state.slopes[zone, :count], np.float64),
            blur_px=float(blur_px[zone]),
            centre_rad=modes[zone, :count],
            prior_rad=_prior(plan)[zone, :count],
        )
        if state.stage == AVERAGE:
            tries[zone, state.step // 2, :count] = modes[zone, :count] - step.modes_rad
        modes[zone, :count] -= gain * step.modes_rad
        covariance[zone, :count, :count] = step.covariance
        shifts[zone], misfit[zone] = gain * step.shift_px, step.misfit
        moved[zone] = float(np.linalg.norm(step.modes_rad))
    state = replace(state, modes_rad=modes, covariance=covariance, moved_rad=moved, misfit=misfit, tries_rad=tries)
    return _steered(plan, state, np.clip(shifts, -2.0, 2.0))


def _averaged(plan: SearchPlan, state: SearchState) -> SearchState:
    """Return the state with the error of the mean of the tries: the solves' own, or their scatter if that is larger."""
    covariance, moved = state.covariance / plan.averages, state.moved_rad.copy()
    for zone in np.flatnonzero(~state.dark & plan.seen.any(axis=1)):
        off = state.tries_rad[zone] - state.tries_rad[zone].mean(axis=0)
        scatter = float(np.sum(off**2)) / max(plan.averages - 1, 1)
        expected = float(np.trace(state.covariance[zone]))
        covariance[zone] *= max(1.0, scatter / max(expected, 1e-12))
        half = plan.averages // 2
        tries = state.tries_rad[zone]
        moved[zone] = float(np.linalg.norm(tries[half:].mean(axis=0) - tries[:half].mean(axis=0))) if half else 0.0
    return replace(state, covariance=covariance, moved_rad=moved)


def _blurs(state: SearchState) -> Array:
    """Return (zones,) px of smoothing: as wide as what is left may be."""
    return np.asarray(np.clip(COARSE_PER_RAD * state.moved_rad, FINE_PX, COARSE_PX))


def _push_sizes(plan: SearchPlan) -> Array:
    """Return (zones, modes) rad over the lit part that each mode is pushed by."""
    largest = np.abs(plan.modes).max(axis=2)
    return np.asarray(np.minimum(PUSH_RAD, LARGEST_PUSH_RAD * _inverse(largest)))


def _prior(plan: SearchPlan) -> Array:
    """Return (zones, modes) how large each combination may be over the lit part."""
    return np.asarray(plan.prior_rad * _inverse(plan.length))


def _inverse(values: Array) -> Array:
    """Return 1 / values, 0 where they are 0."""
    return np.asarray(np.divide(1.0, values, out=np.zeros_like(values), where=values > 0))


def _columns(plan: SearchPlan) -> list[int]:
    return [plan.trial_noll.index(j) for j in plan.noll]
