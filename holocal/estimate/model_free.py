"""The aberration of every zone without a model of the bench: opposite biases and mirrored pictures.

Every frame shows one spot per zone, each with its own trial of Zernike coefficients. Two frames at opposite large
quadratic biases are each other's mirror when the aberration is corrected (`mirrored_pictures`); pushing each visible
mode once at both biases tells how the difference answers to it; a linear solve says what is wrong. With N modes one
such pass takes 2 N + 2 frames, after which every further pair of frames is a new measurement of what is left.

Measured on 12 modes, 25 zones, a camera pixel 3.4 grains wide: 0.3 to 2 rad become 0.007 to 0.012 rad (rms over
the lit part, median zone; the worst 0.035) in 48 to 80 frames; 4 rad become 0.02 rad in 112 frames, where 3 zones in
50 fail and say so.
Second moments and the Gram matrix of gradients, then sharpness, stay at 0.07 to 0.3 rad there in 72 to 144 frames: a
sharp spot is smaller than a pixel, and both are even in the aberration, so that they are flat where it is found.

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

from dataclasses import replace

import numpy as np

from holocal.errors import UsageError
from holocal.estimate.mirrored_pictures import (
    SATURATED,
    Noise,
    Pair,
    centroid_px,
    has_light,
    mirrored_pair,
    share_within,
    solve_step,
)
from holocal.estimate.model_free_result import SearchResult, result
from holocal.estimate.model_free_state import (
    AFTER,
    AVERAGE,
    BEFORE,
    CENTRE,
    DONE,
    PUSH,
    REFINE,
    Array,
    Mask,
    SearchPlan,
    SearchState,
    search_plan,
    start,
)

__all__ = [
    "SearchPlan",
    "SearchResult",
    "SearchState",
    "frames_planned",
    "result",
    "search_plan",
    "start",
    "take",
    "trial",
]

COARSE_PX, FINE_PX = 3.0, 0.7  # smoothing of pictures; measured: at 3 px, 4 rad is found, at 1.5 px it often is not
COARSE_PER_RAD = 5.0  # px of smoothing per rad of the last step
STILL_RAD = 0.15  # a last step above it asks for a new push: the answers were measured too far away
NEAR_RAD = 1.0  # a pass's first step above it does too; measured: after 1.5 rad one zone in ten stops at 0.1 rad


def frames_planned(plan: SearchPlan, state: SearchState) -> int:
    """Return how many frames the search takes in all if no zone asks for another pass."""
    return state.frames if state.done else plan.frames(max(1, state.passes))


def trial(plan: SearchPlan, state: SearchState) -> Array:
    """Return (zones, len(plan.trial_noll)) rad to add to the zones' holograms in the next frame."""
    asked = np.zeros((plan.zones, len(plan.trial_noll)))
    modes = state.modes_rad.copy()
    if state.stage == PUSH and state.step >= 2:
        mode = state.step // 2 - 1
        modes[:, mode] += plan.pushes_rad[:, mode]
    asked[:, plan.columns] = np.einsum("zm,zmj->zj", modes, plan.modes)
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
        (zones, h, w) counts, the dark level subtracted, around each zone's place. Every frame is exposed for itself: a
        spot without bias is some hundred times as bright as a biased one.
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


def _unbiased(plan: SearchPlan, state: SearchState, windows: Array, usable: Mask, noise: Noise) -> SearchState:
    share, sigma = share_within(windows, usable, noise)
    if state.stage == AFTER:
        sigma = np.hypot(state.share_sigma, sigma)
        return replace(state, stage=DONE, share_fall=state.share_before - share, share_sigma=sigma)
    dark = ~has_light(windows, usable, noise)
    state = replace(state, dark=dark, share_before=share, share_sigma=sigma)
    return replace(_steered(plan, state, centroid_px(windows, usable)), stage=CENTRE, step=0)


def _steered(plan: SearchPlan, state: SearchState, shift_px: Array) -> SearchState:
    """Return the state with spots moved back by `shift_px` (zones, 2); dark zones stay."""
    moved = np.where(state.dark[:, None], 0.0, shift_px) @ plan.gradient_per_px.T / 2
    return replace(state, tilt_rad=state.tilt_rad - moved)


def _pushed(plan: SearchPlan, state: SearchState, pair: Pair) -> SearchState:
    """Return the state after a pair of a pass: the plain one, then one per mode; the last one solves."""
    mode = state.step // 2 - 1
    if mode < 0:
        return replace(state, step=state.step + 1, plain=pair.difference, plain_usable=pair.usable)
    size = np.where(plan.seen[:, mode], plan.pushes_rad[:, mode], 1.0)[:, None, None]
    slopes = state.slopes.copy()
    # saturated pixels come and go: one that is missing in either says nothing
    answer = np.where(pair.usable & state.plain_usable, pair.difference - state.plain, 0.0)
    slopes[:, mode] = answer / size
    state = replace(state, step=state.step + 1, slopes=slopes)
    if mode + 1 < plan.modes.shape[1]:
        return state
    blur = np.where(state.passes == 0, COARSE_PX, _blurs(state))
    state = _solved(plan, state, replace(pair, difference=state.plain, usable=state.plain_usable), blur, 1.0)
    return replace(state, stage=REFINE, step=0, passes=state.passes + 1, first_rad=state.moved_rad)


def _corrected(plan: SearchPlan, state: SearchState, pair: Pair) -> SearchState:
    """Return the state after a pair of a refinement or an average."""
    number = state.step // 2 + 1
    if state.stage == REFINE:
        state = replace(_solved(plan, state, pair, _blurs(state), 1.0), step=state.step + 1)
        if number < plan.refinements:
            return state
        moving = ((state.moved_rad > STILL_RAD) | (state.first_rad > NEAR_RAD)) & ~state.dark & plan.seen.any(axis=1)
        again = bool(moving.any()) and state.passes < plan.passes
        return replace(state, stage=PUSH if again else AVERAGE, step=0)
    state = _solved(plan, state, pair, _blurs(state), 1.0 / number)
    if number < plan.averages:
        return replace(state, step=state.step + 1)
    return replace(_averaged(plan, state), stage=AFTER, step=0)


def _solved(plan: SearchPlan, state: SearchState, pair: Pair, blur_px: Array, gain: float) -> SearchState:
    """Return the state with what is wrong taken back, a share `gain` of it."""
    modes, covariance, tries = state.modes_rad.copy(), state.covariance.copy(), state.tries_rad.copy()
    left, square = state.left.copy(), state.left_square.copy()
    moved, misfit, shifts = state.moved_rad.copy(), state.misfit.copy(), np.zeros((plan.zones, 2))
    for zone in np.flatnonzero(~state.dark & plan.seen.any(axis=1)):
        count = int(plan.seen[zone].sum())
        step = solve_step(
            pair,
            int(zone),
            np.asarray(state.slopes[zone, :count], np.float64),
            blur_px=float(blur_px[zone]),
            centre_rad=modes[zone, :count],
            prior_rad=plan.priors_rad[zone, :count],
        )
        if state.stage == AVERAGE:
            tries[zone, state.step // 2, :count] = modes[zone, :count] - step.modes_rad
            left[zone] += step.left / plan.averages
            square[zone] += float(np.sum(step.left**2)) / plan.averages
        modes[zone, :count] -= gain * step.modes_rad
        covariance[zone, :count, :count] = step.covariance
        shifts[zone], misfit[zone] = gain * step.shift_px, step.misfit
        moved[zone] = float(np.linalg.norm(step.modes_rad))
    state = replace(state, modes_rad=modes, covariance=covariance, moved_rad=moved, misfit=misfit, tries_rad=tries)
    state = replace(state, left=left, left_square=square)
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
