"""From a search without a model to the field's correction, its verification, and the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.field_model import DEGREE, FieldModel, ZoneEvidence, fit_field
from holocal.estimate.mirrored_pictures import SATURATED, Noise, mirrored_pair, solve_step
from holocal.estimate.model_free import FINE_PX, SearchPlan, SearchResult, SearchState, result
from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion
from procedures._aberration_light import array_of, correction_of, dark_level, half_tan_of
from procedures._aberration_pictures import extent_of, figures_of, maps_of, mosaic
from procedures._aberration_result import geometry_of, shown_rms, shown_sigma, sigmas_of, summarised
from procedures._aberration_seen import ZoneWindows
from procedures._aberration_truth import left_of, residual_of
from procedures._aberration_windows import cut, cut_picture, lit_pupils, noise_of, places_listed, sharpness

if TYPE_CHECKING:
    from procedures._aberration_search import State

Array = NDArray[np.float64]

LEAST_ERROR_RAD = 0.005  # rms over the lit part, of a zone's evidence: what encoding leaves alike every time
NOT_FOUND = "it was not searched to the end"


@dataclass(frozen=True)
class Fresh:
    """What the verification measured of the searched zones: `modes_rad` (n, modes) left, `covariance` of it.

    `sharp` (n,) is the spots' sharpness in focus, `dark` (n,) where a frame had no light.
    """

    modes_rad: Array
    covariance: Array
    sharp: Array
    dark: NDArray[np.bool_]


def joined(state: State) -> State:
    """Return the state with the field's model of the zones that the search found."""
    _, _, windows = _parts(state)
    found, field = found_of(state), field_of(state)
    valid = np.zeros(state.parameters.zones**2, np.bool_)
    valid[windows.zones] = found.valid
    return replace(state, spots=replace(state.spots, coefficients_rad=field.coefficients, valid=valid))


def found_of(state: State) -> SearchResult:
    """Return what the search says of the zones that were searched."""
    plan, search, _ = _parts(state)
    return result(plan, search)


def field_of(state: State) -> FieldModel:
    """Return the aberration over the field from the zones that the search found."""
    plan, search, windows = _parts(state)
    array, found = array_of(state.spots), found_of(state)
    evidence: list[ZoneEvidence | None] = [None] * len(array.field_tan)
    for at in np.flatnonzero(found.valid):
        evidence[windows.zones[at]] = evidence_of(plan, search, int(at), float(found.residual_sigma_rad[at]))
    return fit_field(evidence, array.field_tan, half_tan_of(state.spots), plan.noll)


def evidence_of(plan: SearchPlan, search: SearchState, zone: int, residual_rad: float) -> ZoneEvidence:
    """Return what a searched zone says of its aberration's coefficients: as much as its lit part shows of them.

    The error is the solves' own, widened evenly to what is expected to be left in all.
    """
    count = int(plan.seen[zone].sum())
    covariance = search.covariance[zone, :count, :count]
    more = max(residual_rad**2 + LEAST_ERROR_RAD**2 - float(np.trace(covariance)), 0.0) / count
    precision = np.linalg.inv(covariance + more * np.eye(count))
    shows = plan.modes[zone, :count] / plan.length[zone, :count, None] ** 2  # modes from coefficients
    return ZoneEvidence(shows.T @ precision @ shows, -shows.T @ precision @ search.modes_rad[zone, :count])


def verified_trial(state: State, sign: int) -> Array:
    """Return (n, trial modes) radians that show the field's correction with `sign` times the bias, spots in place."""
    plan, search, windows = _parts(state)
    asked = np.zeros((plan.zones, len(plan.trial_noll)))
    asked[:, plan.columns] = correction_of(state.spots)[windows.zones]
    asked += sign * plan.bias
    asked[:, :2] = np.einsum("zcj,zj->zc", plan.untilt, asked) + search.tilt_rad
    return asked


def fresh_of(state: State, frames: Sequence[Frame]) -> Fresh:
    """Return what the verification's frames say is left: the mean of a solve per pair, in the search's own modes."""
    plan, search, windows = _parts(state)
    noise, full = Noise(*noise_of(state.spots)), state.spots.facts.camera.full_scale
    counts, usable = cut(state.spots, windows, frames[-1])
    sharp = sharpness(state.spots, windows, counts, usable, lit_pupils(array_of(state.spots), windows.zones))
    left = np.zeros((0, *search.modes_rad.shape))
    covariance, dark = np.zeros_like(search.covariance), search.dark.copy()
    corrected = np.einsum("zmj,zj->zm", plan.modes, correction_of(state.spots)[windows.zones])
    shown = np.divide(corrected, plan.length**2, out=np.zeros_like(corrected), where=plan.seen)
    pairs = (len(frames) - 1) // 2
    for number in range(pairs):
        two = [cut(state.spots, windows, frame) for frame in frames[2 * number : 2 * number + 2]]
        two = [(counts, usable & (counts < SATURATED * full)) for counts, usable in two]
        pair = mirrored_pair(*two[0], *two[1], noise)
        dark |= ~pair.lit
        one = np.zeros_like(search.modes_rad)
        for zone in np.flatnonzero(~dark & plan.seen.any(axis=1)):
            count = int(plan.seen[zone].sum())
            step = solve_step(
                pair,
                int(zone),
                np.asarray(search.slopes[zone, :count], np.float64),
                blur_px=FINE_PX,
                centre_rad=shown[zone, :count],
                prior_rad=plan.priors_rad[zone, :count],
            )
            one[zone, :count] = step.modes_rad
            covariance[zone, :count, :count] += step.covariance / pairs**2
        left = np.concatenate([left, one[None]])
    return Fresh(left.mean(axis=0), covariance, sharp, dark)


def conclusion(state: State, frames: Sequence[Frame]) -> Conclusion:
    """Return the result from the search's end and the verification's frames."""
    _, _, windows = _parts(state)
    spots, chosen = state.spots, state.parameters
    found, fresh, field = found_of(state), fresh_of(state, frames), field_of(state)
    reasons = reasons_of(state, found, fresh)
    before = summarised(_zones_before(state, found, field, reasons))
    after = summarised(_zones_after(state, fresh, field, reasons))
    valid = np.array([not reason for reason in reasons])
    array = array_of(spots)
    met = _met(state, valid, after)
    extent = extent_of(spots)
    maps, units = maps_of(spots, valid)
    first_dark, last_dark = (dark_level(spots, s) for s in (float(state.focus_s[0]), frames[-1].exposure_s))
    places = places_listed(windows, len(valid))
    mosaics = (
        mosaic(chosen.zones, places, state.focus[0], first_dark),
        mosaic(chosen.zones, places, frames[-1].counts, last_dark),
    )
    return Conclusion(
        before=before,
        after=after,
        targets={
            "median_wavefront_rms_rad": chosen.target_median_rad,
            "worst_wavefront_rms_rad": chosen.target_worst_rad,
        },
        targets_met=met,
        sentence=_sentence(state, valid, before, after, met),
        maps=maps,
        before_map=mosaics[0],
        after_map=mosaics[1],
        map_units=units | {"before": "counts", "after": "counts"},
        map_metadata={"wavelength_nm": chosen.wavelength_nm},
        extent_deg=extent,
        sigma={"before": sigmas_of(before), "after": sigmas_of(after)},
        extra={
            "mode": "search",
            "wavelength_nm": chosen.wavelength_nm,
            "noll": list(chosen.noll),
            "correction": "the field's, joined from the zones that were found",
            "field": {
                "half_tan": list(half_tan_of(spots)),
                "degree": DEGREE,
                "coefficients_rad": spots.coefficients_rad.tolist(),
                "high_share": field.high,
                "deviation_share": field.deviation,
            },
            "search": _search_facts(state, found),
            "exposures_s": [*spots.exposures_s.tolist(), *state.taken_s.tolist(), *(f.exposure_s for f in frames)],
            "zones_lit": int(array.on.sum()),
            "zones_believed": int(valid.sum()),
            "rig_facts": geometry_of(spots),
        },
        figures=figures_of(chosen, mosaics, valid, before, after, extent),
    )


def _met(state: State, valid: NDArray[np.bool_], after: Mapping[str, Any]) -> bool:
    """Return whether the targets hold and at most a fifth of the lit zones is left out, as in mode model."""
    chosen, on = state.parameters, array_of(state.spots).on
    met = valid.any() and after["median"]["wavefront_rms_rad"] <= chosen.target_median_rad
    met = met and after["worst"]["wavefront_rms_rad"] <= chosen.target_worst_rad
    return bool(met and np.count_nonzero(on & ~valid) <= int(on.sum()) // 5)


def _sentence(
    state: State, valid: NDArray[np.bool_], before: Mapping[str, Any], after: Mapping[str, Any], met: bool
) -> str:
    chosen, on = state.parameters, array_of(state.spots).on
    first, last, worst = before["median"], after["median"], after["worst"]["wavefront_rms_rad"]
    said = (
        f"wavefront {first['wavefront_rms_rad']:.3f} -> {last['wavefront_rms_rad']:.3f} rad rms (median of "
        f"{int(valid.sum())} zones; target {chosen.target_median_rad:g}), worst {worst:.3f} (target "
        f"{chosen.target_worst_rad:g}), sharpness {first['sharpness']:.2f} -> {last['sharpness']:.2f}, searched "
        f"without a model: {'met' if met else 'not met'}"
    )
    if failed := np.count_nonzero(on & ~valid):
        said += f"; {failed} of {int(on.sum())} lit zones were not found and take the others' prediction"
    return said


def _search_facts(state: State, found: SearchResult) -> dict[str, Any]:
    """Return what is the search's own in the result: each zone's correction before the zones were joined."""
    plan, search, windows = _parts(state)
    return {
        "frames": search.frames,
        "passes": search.passes,
        "modes_seen": plan.seen.sum(axis=1).tolist(),
        "zones": windows.zones.tolist(),
        "aberration_rad": found.aberration_rad.tolist(),
        "expected_left_rad": found.residual_sigma_rad.tolist(),
        "valid": found.valid.tolist(),
    }


def reasons_of(state: State, found: SearchResult, fresh: Fresh) -> list[str]:
    """Return why each zone of the field has no wavefront of its own; empty for those that have one."""
    _, _, windows = _parts(state)
    reasons = list(windows.reasons)
    said = dict(sentence.split(": ", 1) for sentence in found.sentences)
    for at, zone in enumerate(windows.zones):
        reasons[zone] = said.get(f"Zone {at}", "" if found.valid[at] else NOT_FOUND)
        if not reasons[zone] and fresh.dark[at]:
            reasons[zone] = "a frame of the verification had no light of it"
    return reasons


def _zones_before(state: State, found: SearchResult, field: FieldModel, reasons: Sequence[str]) -> list[dict[str, Any]]:
    """Return every zone's numbers before: its own coefficients where they were found, else the others' prediction."""
    plan, search, windows = _parts(state)
    counts, usable = cut_picture(state.spots, windows, state.focus[0], float(state.focus_s[0]))
    sharp = sharpness(state.spots, windows, counts, usable, lit_pupils(array_of(state.spots), windows.zones))
    zones = []
    for zone, reason in enumerate(reasons):
        at = _at(windows, zone)
        line = _predicted(state, field, zone, reason, field.zones[zone])
        if at is not None and not reason:
            line |= {
                "wavefront_rms_rad": float(np.linalg.norm(search.modes_rad[at])),
                "wavefront_sigma_rad": float(found.residual_sigma_rad[at]),
                "coefficients_rad": _named(plan.noll, found.aberration_rad[at]),
                "sigma_rad": _named(plan.noll, found.sigma_rad[at]),
            }
        zones.append(line | _sharp(sharp, at))
    return zones


def _zones_after(state: State, fresh: Fresh, field: FieldModel, reasons: Sequence[str]) -> list[dict[str, Any]]:
    """Return every zone's numbers after: what the verification's pairs say is left of it."""
    plan, _, windows = _parts(state)
    correction = correction_of(state.spots)
    zones = []
    for zone, reason in enumerate(reasons):
        at = _at(windows, zone)
        line = _predicted(state, field, zone, reason, field.zones[zone] + correction[zone])
        if at is not None and not fresh.dark[at] and plan.seen[at].any():  # measured, though it was not found
            spread = np.einsum("mj,mn,nj->j", plan.modes[at], fresh.covariance[at], plan.modes[at])
            line |= {
                "wavefront_rms_rad": float(np.linalg.norm(fresh.modes_rad[at])),
                "wavefront_sigma_rad": float(np.sqrt(np.trace(fresh.covariance[at]))),
                "coefficients_rad": _named(plan.noll, fresh.modes_rad[at] @ plan.modes[at]),
                "sigma_rad": _named(plan.noll, np.sqrt(np.maximum(spread, 0.0))),
            }
        zones.append(line | _sharp(fresh.sharp, at))
    return zones


def _predicted(state: State, field: FieldModel, zone: int, reason: str, coefficients: Array) -> dict[str, Any]:
    """Return a zone's numbers as all zones together predict them."""
    array = array_of(state.spots)
    lit, covariance, nowhere = bool(array.on[zone]), field.zone_covariance[zone], np.zeros(2)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return {
        "field_deg": [float(angle) for angle in np.degrees(np.arctan(array.field_tan[zone]))],
        "lit": float(array.lit[zone]),
        "valid": not reason,
        "reason": reason,
        "wavefront_rms_rad": shown_rms(array, zone, coefficients, nowhere) if lit else None,
        "wavefront_sigma_rad": shown_sigma(array, zone, covariance, nowhere) if lit else None,
        "coefficients_rad": _named(field.noll, coefficients),
        "sigma_rad": _named(field.noll, sigma),
        "chi2": None,
    }


def _sharp(sharp: Array, at: int | None) -> dict[str, float | None]:
    return {"sharpness": None if at is None or not np.isfinite(sharp[at]) else float(sharp[at])}


def _named(noll: Sequence[int], values: Array) -> dict[str, float]:
    return {str(j): float(value) for j, value in zip(noll, values, strict=True)}


def _at(windows: ZoneWindows, zone: int) -> int | None:
    found = np.flatnonzero(windows.zones == zone)
    return int(found[0]) if len(found) else None


def _parts(state: State) -> tuple[SearchPlan, SearchState, ZoneWindows]:
    assert state.plan is not None
    assert state.search is not None
    assert state.windows is not None
    return state.plan, state.search, state.windows


def own_residual_of(done: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the field's correction leaves of the exact phase, and what each zone's own coefficients would."""
    own = np.array([list(zone["coefficients_rad"].values()) for zone in done.before["zones"]])
    return {**residual_of(done, truth), "zones_own_residual_rms_rad": left_of(done, truth, own[None])[0]}
