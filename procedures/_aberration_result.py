"""From the aberration's frames to its estimate, and to the result: numbers, maps, pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.field_model import DEGREE
from holocal.estimate.spot_fit import ZoneProblem
from holocal.estimate.zone_data import Noise
from holocal.loop.procedure import Conclusion
from holocal.optics.zernike import zernike
from holocal.threads import each
from procedures._aberration_directions import lit_grid
from procedures._aberration_light import (
    array_of,
    correction_of,
    dark_level,
    half_tan_of,
    places_in,
    recipe_taken,
    seen_in,
)
from procedures._aberration_pictures import extent_of, figures_of, maps_of, mosaic_of
from procedures._aberration_posterior import posterior_of_zone
from procedures._aberration_spots import SpotArray
from procedures._aberration_zones import CameraNoise, Estimate, Shown, estimate

if TYPE_CHECKING:
    from procedures._aberration_model import State

Array = NDArray[np.float64]
Extent = tuple[float, float, float, float]

# What the model of a picture leaves beside noise (docs/physics.md 10): of a pixel, and of the brightest pixel.
MODEL_ERROR, FAINT_ERROR = 0.01, 0.001
UNKNOWN_RAD = 99.0
PLACES_PX = (-1 / 3, 0.0, 1 / 3)  # of a spot in a pixel, each way
_LAST: dict[str, Estimate] = {}


def estimate_of(state: State, *, before: Estimate | None = None) -> Estimate:
    """Return what all the state's frames say of all zones; the last one is kept for the conclusion."""
    given = (state.pictures, state.exposures_s, state.corrections_rad, state.gains, state.seeds)
    key = sha256(repr((state.facts, state.parameters, before is None)).encode())
    for part in given:
        key.update(np.ascontiguousarray(part).tobytes())
    if key.hexdigest() not in _LAST:
        _LAST.clear()
        _LAST[key.hexdigest()] = _estimate_of(state, before)
    return _LAST[key.hexdigest()]


def _estimate_of(state: State, before: Estimate | None) -> Estimate:
    count = len(state.pictures)
    dark = np.array([dark_level(state, float(s)) for s in state.exposures_s])
    pictures = state.pictures.astype(np.float32) - dark[:, None, None].astype(np.float32)
    shown = Shown(
        pictures, state.exposures_s, state.defocus, [seen_in(state, recipe_taken(state, i)) for i in range(count)]
    )
    known, full = state.reference, state.facts.camera.full_scale
    flicker = MODEL_ERROR**2 + (0.0 if known is None else known.flicker_squared)
    read_variance, gain = (1.0, full / 10_000) if known is None else (known.read_variance, known.gain)
    noise = Noise(read_variance, gain, flicker, FAINT_ERROR)
    usable = np.ones(pictures.shape[1:], np.bool_) if known is None else known.usable
    camera = CameraNoise(noise, usable, full, dark)
    where = places_in(state, 0)
    return estimate(
        array_of(state), where, shown, camera, state.parameters.noll, before=before, device=state.parameters.device
    )


def estimated(state: State) -> State:
    """Return the state with the field's model from all its frames."""
    found = estimate_of(state)
    array = array_of(state)
    zones, pupil = [int(zone) for zone in np.flatnonzero(found.valid)], found.pupil_m
    rms = [shown_rms(array, zone, found.field.zones[zone], pupil) for zone in zones]
    sure = [shown_sigma(array, zone, found.field.zone_covariance[zone], pupil) for zone in zones]
    return replace(
        state,
        coefficients_rad=found.field.coefficients,
        valid=found.valid,
        wavefront_rad=float(np.median(rms)) if rms else UNKNOWN_RAD,
        expected_rad=float(np.median(sure)) if sure else UNKNOWN_RAD,
    )


def _lit_basis(array: SpotArray, zone: int, noll: tuple[int, ...], pupil_m: Array) -> Array:
    """Return the modes over a zone's lit pupil, piston and tilt taken out, each times the root of its weight.

    `pupil_m` (2,) is where the pupil lies; a hologram of the nominal bench fills its own place for it.
    """
    grid, root = lit_grid(array, zone, pupil_m)
    radius = array.facts.pupil_diameter_m / 2
    plane = np.concatenate([np.ones((len(grid), 1)), grid / radius], axis=1) * root[:, None]
    modes = zernike(noll, grid[:, 0] / radius, grid[:, 1] / radius).T * root[:, None]
    left = modes - plane @ np.linalg.lstsq(plane, modes, rcond=None)[0]
    return np.asarray(left)


def shown_rms(array: SpotArray, zone: int, coefficients: Array, pupil_m: Array) -> float:
    """Return the rms of a wavefront over a zone's lit pupil, tilt and piston removed, radians."""
    modes = _lit_basis(array, zone, tuple(range(4, 4 + len(coefficients))), pupil_m)
    return float(np.linalg.norm(modes @ coefficients))


def shown_sigma(array: SpotArray, zone: int, covariance: Array, pupil_m: Array) -> float:
    """Return the rms error over a zone's lit pupil that a covariance of its coefficients means, radians."""
    modes = _lit_basis(array, zone, tuple(range(4, 4 + len(covariance))), pupil_m)
    return float(np.sqrt(max(np.trace(modes @ covariance @ modes.T), 0.0)))


def conclusion(state: State, fresh: State) -> Conclusion:
    """Return the result from the final state and the verification's frames."""
    array, chosen = array_of(state), state.parameters
    found = estimate_of(state)
    check = estimate_of(fresh, before=found)
    correction = correction_of(state)
    left = check.field.zones + correction
    sharp = (sharpness(state, found, 0.0), sharpness(fresh, check, 0.0))
    wider = retest(array, found, check)
    before = side_of(array, found, found.field.zones, wider**2 * found.field.zone_covariance, sharp[0], chosen.noll)
    after = side_of(array, check, left, wider**2 * check.field.zone_covariance, sharp[1], chosen.noll)
    median, worst = after["median"]["wavefront_rms_rad"], after["worst"]["wavefront_rms_rad"]
    believed = int(check.valid.sum())
    lit = int(array.on.sum())
    unseen = [zone for zone in np.flatnonzero(array.on) if found.fits[zone] is None]
    failed = [
        zone for zone in np.flatnonzero(array.on)
        if found.fits[zone] is not None and not (found.valid[zone] and check.valid[zone])
    ]  # fmt: skip
    met = believed > 0 and median <= chosen.target_median_rad and worst <= chosen.target_worst_rad
    met = met and len(failed) <= max((lit - len(unseen)) // 5, 1) and len(unseen) <= lit // 2
    sentence = (
        f"wavefront {before['median']['wavefront_rms_rad']:.3f} -> {median:.3f} rad rms (median of {believed} zones; "
        f"target {chosen.target_median_rad:g}), worst {worst:.3f} (target {chosen.target_worst_rad:g}), sharpness "
        f"{before['median']['sharpness']:.2f} -> {after['median']['sharpness']:.2f}: {'met' if met else 'not met'}"
    )
    if failed:
        sentence += f"; {len(failed)} of {lit} lit zones are not believed and take the others' prediction"
    if unseen:
        sentence += f"; {len(unseen)} of {lit} zones that should be lit are not in the picture"
    extent = extent_of(state)
    maps, units = maps_of(state, found.valid)
    mosaics = mosaic_of(state, found), mosaic_of(fresh, check)
    sampled = posterior_of_zone(state, found) if chosen.posterior else None
    return Conclusion(
        before=before,
        after=after,
        targets={
            "median_wavefront_rms_rad": chosen.target_median_rad,
            "worst_wavefront_rms_rad": chosen.target_worst_rad,
        },
        targets_met=bool(met),
        sentence=sentence,
        maps=maps,
        before_map=mosaics[0],
        after_map=mosaics[1],
        map_units=units | {"before": "counts", "after": "counts"},
        map_metadata={"wavelength_nm": chosen.wavelength_nm},
        extent_deg=extent,
        sigma={"before": sigmas_of(before), "after": sigmas_of(after)},
        extra={
            "mode": "model",
            "wavelength_nm": chosen.wavelength_nm,
            "noll": list(chosen.noll),
            "field": {
                "half_tan": list(half_tan_of(state)),
                "degree": DEGREE,
                "coefficients_rad": state.coefficients_rad.tolist(),
                "high_share": found.field.high,
                "deviation_share": found.field.deviation,
            },
            "left_out": _left_out(array, found),
            "sigma_widened_by": wider,
            "exposures_s": [*state.exposures_s.tolist(), *fresh.exposures_s.tolist()],
            "verified_with": {"gains": state.next_gain.tolist(), "exposure_s": float(fresh.exposures_s[0])},
            "zones_lit": lit,
            "zones_believed": believed,
            "rig_facts": geometry_of(state),
            "posterior": None if sampled is None else sampled[1],
        },
        figures=(
            *figures_of(chosen, mosaics, found.valid, before, after, extent),
            *(() if sampled is None else (sampled[0],)),
        ),
    )


def retest(array: SpotArray, one: Estimate, other: Estimate) -> float:
    """Return by how much errors are to be widened so that two estimates from different frames agree; at least 1.

    What the model of the pictures lacks is not noise: it is seen only where other frames say something else.
    """
    off = []
    for zone in np.flatnonzero(one.valid & other.valid):
        at = int(zone)
        difference = shown_rms(array, at, one.field.zones[at] - other.field.zones[at], one.pupil_m)
        spread = one.field.zone_covariance[at] + other.field.zone_covariance[at]
        off.append((difference / max(shown_sigma(array, at, spread, one.pupil_m), 1e-9)) ** 2)
    return float(np.sqrt(max(1.0, float(np.mean(off))))) if off else 1.0


def geometry_of(state: State) -> dict[str, float]:
    """Return what `residual_of` must know of panel and pupil."""
    facts = state.facts
    return {
        "panel_width": facts.slm.width,
        "panel_height": facts.slm.height,
        "pitch_m": facts.slm.pitch_m,
        "pupil_diameter_m": facts.pupil_diameter_m,
        "eye_relief_m": facts.eye_relief_m,
    }


def side_of(
    array: SpotArray, found: Estimate, means: Array, covariance: Array, sharp: Array, noll: tuple[int, ...]
) -> dict[str, Any]:
    """Return `before` or `after`: every zone's numbers, and the median and the worst of those believed."""
    zones = []
    for zone, tangent in enumerate(array.field_tan):
        fit = found.fits[zone]
        sigma = np.sqrt(np.maximum(np.diag(covariance[zone]), 0.0))
        lit = bool(array.on[zone])
        zones.append(
            {
                "field_deg": [float(angle) for angle in np.degrees(np.arctan(tangent))],
                "lit": float(array.lit[zone]),
                "valid": bool(found.valid[zone]),
                "reason": found.reasons[zone],
                "wavefront_rms_rad": shown_rms(array, zone, means[zone], found.pupil_m) if lit else None,
                "wavefront_sigma_rad": shown_sigma(array, zone, covariance[zone], found.pupil_m) if lit else None,
                "sharpness": None if np.isnan(sharp[zone]) else float(sharp[zone]),
                "coefficients_rad": {str(j): float(c) for j, c in zip(noll, means[zone], strict=True)},
                "sigma_rad": {str(j): float(s) for j, s in zip(noll, sigma, strict=True)},
                "chi2": None if fit is None else fit.chi2,
            }
        )
    return summarised(zones)


def summarised(zones: list[dict[str, Any]]) -> dict[str, Any]:
    """Return `before` or `after`: the zones, and the median and the worst of those that are valid."""
    valid = [zone for zone in zones if zone["valid"]]
    rms = [zone["wavefront_rms_rad"] for zone in valid]
    sharpest = [zone["sharpness"] for zone in valid if zone["sharpness"] is not None]
    nothing = {"wavefront_rms_rad": UNKNOWN_RAD, "sharpness": 0.0}
    return {
        "median": {
            "wavefront_rms_rad": float(np.median(rms)),
            "sharpness": float(np.median(sharpest)) if sharpest else 0.0,
        }
        if rms
        else nothing,
        "worst": {"wavefront_rms_rad": float(np.max(rms)), "sharpness": float(np.min(sharpest, initial=1.0))}
        if rms
        else nothing,
        "zones": zones,
    }


def sigmas_of(side: Mapping[str, Any]) -> dict[str, float]:
    """Return the standard errors of a side's median and worst wavefront.

    The zones share their errors, so the median is known no better than a zone.
    """
    valid = [zone for zone in side["zones"] if zone["valid"] and zone["wavefront_sigma_rad"] is not None]
    if not valid:
        return {}
    worst = max(valid, key=lambda zone: float(zone["wavefront_rms_rad"]))
    return {
        "median_wavefront_rms_rad": float(np.median([zone["wavefront_sigma_rad"] for zone in valid])),
        "worst_wavefront_rms_rad": float(worst["wavefront_sigma_rad"]),
    }


def sharpness(state: State, found: Estimate, defocus: float) -> Array:
    """Return how concentrated every zone's spot in focus is, (zones,): 1 is what the frame would give unaberrated.

    The sum of squares over the square of the sum of a window's pixels, noise taken out. How much of a spot of half a
    pixel a pixel holds depends on where in it the spot lies: the picture is compared to the model's at its own place,
    and that, over all places in a pixel, to the model's without a wavefront. NaN where there is no such frame or zone.
    """
    out = np.full(len(found.fits), np.nan)
    frames = np.flatnonzero(state.defocus == defocus)
    if not len(frames):
        return out
    frame = int(frames[0])

    def of_zone(zone: int) -> float:
        fit, problem, box = found.fits[zone], found.problems[zone], found.boxes[zone]
        if fit is None or problem is None or box is None:
            return float("nan")
        data, good = problem.data.counts[frame], problem.data.good[frame]
        model = problem.expected(fit.vector)[frame]
        measured = _concentration(data, problem.noise.variance(model), good)
        at_place = _concentration(model, np.zeros_like(model), good)
        alone = problem.of_frames((frame,))
        own = alone.begun_at(fit.vector, fit.layout)
        perfect = own.copy()
        # the levels hold the correction: the bench's own wavefront is what undoes it
        correction = state.corrections_rad[frame, zone]
        perfect[fit.layout.wavefront] = _terms_of(box, found.degree, -correction, state.parameters.noll, state)
        typical, best = _over_places(alone, own), _over_places(alone, perfect)
        return measured / at_place * typical / best if at_place > 0 and best > 0 else float("nan")

    return np.array(each(of_zone, len(out)))


def _over_places(problem: ZoneProblem, vector: Array) -> float:
    """Return a spot's concentration, its mean over where in a pixel it lies."""
    model, found = problem.model, []
    per_pixel = model.pupil.wavenumber * model.window.pixel * np.asarray(model.box.half_m)
    for x in PLACES_PX:
        for y in PLACES_PX:
            tilted = vector.copy()
            tilted[:2] += per_pixel * (x, y)
            expected = problem.expected(tilted)[0]
            found.append(_concentration(expected, np.zeros_like(expected), np.ones_like(expected, np.bool_)))
    return float(np.mean(found))


def _terms_of(box: Any, degree: int, coefficients: Array, noll: tuple[int, ...], state: State) -> Array:
    from holocal.estimate.field_model import legendre_of_noll

    radius = state.facts.pupil_diameter_m / 2
    return np.asarray((legendre_of_noll(noll, box, degree, radius) @ coefficients)[1:])


def _concentration(counts: Array, noise: Array, good: NDArray[np.bool_]) -> float:
    total = float(np.sum(counts[good]))
    return float(np.sum(counts[good] ** 2 - noise[good])) / total**2 if total > 0 else 0.0


def _left_out(array: SpotArray, found: Estimate) -> dict[str, Any]:
    """Return how well every zone is predicted by all the others: the field's own check."""
    off, sigma = [], []
    for zone in np.flatnonzero(found.valid):
        difference = found.field.predicted[zone] - found.field.zones[zone]
        off.append(shown_rms(array, int(zone), difference, found.pupil_m))
        sigma.append(shown_sigma(array, int(zone), found.field.predicted_covariance[zone], found.pupil_m))
    if not off:
        return {"median_rad": None, "worst_rad": None, "sigma_median_rad": None}
    return {
        "median_rad": float(np.median(off)),
        "worst_rad": float(np.max(off)),
        "sigma_median_rad": float(np.median(sigma)),
    }
