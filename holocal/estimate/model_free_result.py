"""What a search without a model has found, how sure it is, and what to say of a zone that did not work."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from holocal.estimate.model_free_state import AFTER, DONE, Array, Mask, SearchPlan, SearchState, inverse

LARGEST_SIGMA_RAD = 0.15
LARGEST_DRIFT_RAD = 0.3
LARGEST_UNEXPLAINED_RAD = 0.1
LARGEST_FALL = 0.15  # of the share of light in the spot's brightest 3 x 3 pixels


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


def result(plan: SearchPlan, state: SearchState) -> SearchResult:
    """Return what the search has found so far; before it is done no zone is valid."""
    correction = np.einsum("zm,zmj->zj", state.modes_rad, plan.modes)
    # what the lit part does not show is taken to be as large as what it shows, direction by direction in Noll terms
    usual = np.linalg.norm(correction, axis=1) / np.sqrt(np.maximum(plan.seen.sum(axis=1), 1))
    usual = np.where(state.dark | (usual == 0), plan.prior_rad, np.minimum(usual, plan.prior_rad))
    hidden = np.maximum(1 - np.einsum("zmj,zm->zj", plan.modes**2, inverse(plan.length) ** 2), 0.0)
    seen = np.einsum("zmj,zmn,znj->zj", plan.modes, state.covariance, plan.modes)
    sigma = np.sqrt(np.maximum(seen, 0.0) + usual[:, None] ** 2 * hidden)
    random = np.sqrt(np.einsum("zmm->z", state.covariance))
    residual = np.hypot(random, usual * plan.dropped)
    if state.stage in (AFTER, DONE):
        residual = np.hypot(residual, [_unexplained(plan, state, zone) for zone in range(plan.zones)])
    reasons = [_reason(plan, state, zone, float(random[zone])) for zone in range(plan.zones)]
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
        return "a frame had no light that stands out of the noise; it was not searched."
    if not plan.seen[zone].any():
        return "none of the modes changes the wavefront over its lit part; nothing was corrected."
    if state.stage not in (AFTER, DONE):
        return ""
    if sigma_rad > LARGEST_SIGMA_RAD or state.moved_rad[zone] > LARGEST_DRIFT_RAD:
        return (
            f"the search did not settle: last step {state.moved_rad[zone]:.2f} rad, error {sigma_rad:.2f} rad, limits "
            f"{LARGEST_DRIFT_RAD:g} and {LARGEST_SIGMA_RAD:g}; start from a neighbour's correction or with fewer modes."
        )
    if (unexplained := _unexplained(plan, state, zone)) > LARGEST_UNEXPLAINED_RAD:
        return (
            f"the pictures keep a difference, as that of {unexplained:.2f} rad, that no searched mode explains "
            f"(limit {LARGEST_UNEXPLAINED_RAD:g}); search more modes, start from a neighbour's correction, or "
            f"check the lit part that was expected."
        )
    if state.share_fall[zone] > LARGEST_FALL + 4 * state.share_sigma[zone]:
        return (
            f"the spot did not get sharper: the share of its light within 3 x 3 pixels fell by "
            f"{state.share_fall[zone]:.2f} from {state.share_before[zone]:.2f}; start from a neighbour's correction."
        )
    return ""


def _unexplained(plan: SearchPlan, state: SearchState, zone: int) -> float:
    """Return rad of an average mode whose answer is as large as what all averaged pairs left over alike."""
    alike = float(np.sum(state.left[zone] ** 2))  # of the mean of n: what is random in it is 1 / n of one's
    n = plan.averages
    lasting = max(alike - (float(state.left_square[zone]) - alike) / (n - 1), 0.0)
    answers = np.asarray(state.slopes[zone, plan.seen[zone]], np.float64)
    size = float(np.sum(answers**2)) / max(len(answers), 1)
    return float(np.sqrt(lasting / max(size, 1e-12)))
