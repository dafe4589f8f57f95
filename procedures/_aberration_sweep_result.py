"""From a sweep's frames to where every zone is sharpest, its contact sheet, and the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Figure
from procedures._aberration_light import array_of, dark_level
from procedures._aberration_pictures import extent_of, mosaic
from procedures._aberration_windows import cut, lit_pupils, places_listed, sharpness

if TYPE_CHECKING:
    from procedures._aberration_sweep import State

Array = NDArray[np.float64]

WIDEST = 9  # columns of the contact sheet: more zones are shown by the field's middle row
TILE = 25  # camera pixels of a cell's side
CURVES = 4  # zones whose sharpness is drawn
NEAR = 5  # coefficients round the sharpest that the parabola is fitted to
LEAST_RISE = 3.0  # of the sharpness over the sweep, in errors of it: below, the polynomial is not seen


def swept(state: State, frames: Sequence[Frame]) -> State:
    """Return the state with the sweep's windows, their sharpness, and each zone's best coefficient."""
    assert state.windows is not None
    parts = [cut(state.spots, state.windows, frame) for frame in frames]
    lit = lit_pupils(array_of(state.spots), state.windows.zones)
    sharp = np.array([sharpness(state.spots, state.windows, *part, lit) for part in parts])
    found = [best_of(state.coefficients_rad, one) for one in sharp.T]
    return replace(
        state,
        counts=np.array([counts for counts, _ in parts]),
        usable=np.array([usable for _, usable in parts]),
        exposures_s=np.array([frame.exposure_s for frame in frames]),
        sharp=sharp,
        best_rad=np.array([best for best, _, _ in found]),
        sigma_rad=np.array([sigma for _, sigma, _ in found]),
        reasons=tuple(reason for _, _, reason in found),
    )


def best_of(coefficients_rad: Array, sharp: Array) -> tuple[float, float, str]:
    """Return where a parabola through the sharpness near its largest peaks, the error of that, and why it is not known.

    The error is from the parabola's residuals; with three points there are none left, and it is the range's step.

    >>> x = np.linspace(-3, 3, 9)
    >>> best, sigma, reason = best_of(x, 1 - 0.05 * (x - 0.6) ** 2)
    >>> round(best, 3), sigma < 1e-6, reason
    (0.6, True, '')
    """
    known = np.isfinite(sharp)
    if np.count_nonzero(known) < 3:
        return 0.0, float("inf"), "no light is seen where its spot should be"
    x, y = coefficients_rad[known], sharp[known]
    top = int(np.argmax(y))
    low = int(np.clip(top - NEAR // 2, 0, max(len(x) - NEAR, 0)))
    x, y = x[low : low + NEAR], y[low : low + NEAR]
    middle, step = float(x.mean()), float(coefficients_rad[1] - coefficients_rad[0])
    design = np.stack([np.ones_like(x), x - middle, (x - middle) ** 2], axis=1)
    terms, *_ = np.linalg.lstsq(design, y, rcond=None)
    spare = len(x) - 3
    scatter = float(np.sqrt(np.sum((y - design @ terms) ** 2) / spare)) if spare else 0.0
    at = float(x[np.argmax(y)])
    best = middle - float(terms[1] / (2 * terms[2])) if terms[2] < 0 else float("nan")
    if not coefficients_rad[0] <= best <= coefficients_rad[-1]:
        reason = "its sharpness has no maximum inside the range"
        if at in (coefficients_rad[0], coefficients_rad[-1]):
            reason = f"it is sharpest at the end of the range, {at:+.2f} rad: sweep farther"
        return at, float("inf"), reason
    if np.ptp(y) < LEAST_RISE * scatter:
        return at, float("inf"), "its sharpness does not depend on the polynomial, but for noise"
    covariance = scatter**2 * np.linalg.inv(design.T @ design)
    slope = np.array([0.0, -1 / (2 * terms[2]), terms[1] / (2 * terms[2] ** 2)])
    sigma = float(np.sqrt(slope @ covariance @ slope)) if spare else step
    return best, sigma, ""


def columns_of(state: State) -> list[int]:
    """Return which of the zones looked at are the sheet's columns: all, or those of the field's middle row."""
    assert state.windows is not None
    zones, side = state.windows.zones, state.parameters.zones
    if len(zones) <= WIDEST:
        return list(range(len(zones)))
    return [at for at, zone in enumerate(zones) if zone // side == side // 2]


def contact_sheet(state: State) -> NDArray[np.float32]:
    """Return the windows of the sweep, a row per coefficient and a column per zone, each zone on one scale of grey.

    (k cells, columns cells) of `TILE` pixels, rows of falling coefficients; 1 is the zone's brightest pixel of all
    rows, counts per second; a square root makes the faint parts seen.
    """
    columns = columns_of(state)
    light = np.where(state.usable, state.counts, 0.0)[:, columns] / state.exposures_s[:, None, None, None]
    trim = max(0, (light.shape[-1] - TILE) // 2)
    light = np.maximum(light[..., trim : light.shape[-1] - trim, trim : light.shape[-1] - trim], 0.0)
    light = np.sqrt(light / np.maximum(light.max(axis=(0, 2, 3), keepdims=True), 1e-9))[::-1]
    rows, count, side, _ = light.shape
    return np.asarray(light.transpose(0, 2, 1, 3).reshape(rows * side, count * side), np.float32)


def conclusion(state: State, frames: Sequence[Frame]) -> Conclusion:
    """Return the result. There is no target: `targets_met` says that half of the zones or more have a maximum."""
    assert state.windows is not None
    chosen, windows = state.parameters, state.windows
    lit = lit_pupils(array_of(state.spots), windows.zones)
    sharp = [sharpness(state.spots, windows, *cut(state.spots, windows, frame), lit) for frame in frames]
    before, after = (_side(state, one, best) for one, best in ((sharp[0], False), (sharp[1], True)))
    found = int(state.valid.sum())
    met = 2 * found >= len(windows.zones)
    median = float(np.median(state.best_rad[state.valid])) if found else None
    sentence = f"Noll {chosen.sweep_noll} swept from {chosen.sweep_from_rad:g} to {chosen.sweep_to_rad:g} rad: "
    if median is not None:
        sentence += (
            f"sharpest at {median:+.2f} rad (median of {found} of {len(windows.zones)} zones), "
            f"sharpness {before['median']['sharpness']:.2f} -> {after['median']['sharpness']:.2f} there; "
        )
    sentence += "nothing is corrected" if met else "fewer than half of the zones have a maximum inside the range"
    places = places_listed(windows, chosen.zones**2)
    dark = [dark_level(state.spots, frame.exposure_s) for frame in frames]
    mosaics = [mosaic(chosen.zones, places, f.counts, d) for f, d in zip(frames, dark, strict=True)]
    return Conclusion(
        before=before,
        after=after,
        targets={},
        targets_met=met,
        sentence=sentence,
        maps={},
        before_map=mosaics[0],
        after_map=mosaics[1],
        map_units={"before": "counts", "after": "counts"},
        map_metadata={"wavelength_nm": chosen.wavelength_nm},
        extent_deg=extent_of(state.spots),
        extra={
            "mode": "sweep",
            "correction": "none",
            "wavelength_nm": chosen.wavelength_nm,
            "noll": [chosen.sweep_noll],
            "sweep": _sweep_facts(state, median),
            "zones_lit": int(array_of(state.spots).on.sum()),
            "zones_believed": found,
            "exposures_s": [
                *state.spots.exposures_s.tolist(),
                *state.exposures_s.tolist(),
                *(frame.exposure_s for frame in frames),
            ],
        },
        figures=_figures(state, mosaics),
    )


def _sweep_facts(state: State, median: float | None) -> dict[str, Any]:
    """Return what the sweep measured: the sharpness (coefficients x zones), the best coefficients and their errors."""
    assert state.windows is not None
    ok = state.valid
    return {
        "noll": state.parameters.sweep_noll,
        "coefficients_rad": state.coefficients_rad.tolist(),
        "zones": state.windows.zones.tolist(),
        "sharpness": [[float(v) if np.isfinite(v) else None for v in row] for row in state.sharp],
        "best_rad": [float(b) if good else None for b, good in zip(state.best_rad, ok, strict=True)],
        "sigma_rad": [float(s) if good else None for s, good in zip(state.sigma_rad, ok, strict=True)],
        "median_rad": median,
        "median_sigma_rad": float(np.median(state.sigma_rad[ok])) if ok.any() else None,
    }


def _side(state: State, sharp: Array, best: bool) -> dict[str, Any]:
    """Return `before` or `after` with the contract's keys; no wavefront is measured, so none is given."""
    assert state.windows is not None
    array, noll, windows = array_of(state.spots), str(state.parameters.sweep_noll), state.windows
    zones: list[dict[str, Any]] = []
    for zone, tangent in enumerate(array.field_tan):
        at = next(iter(np.flatnonzero(windows.zones == zone).tolist()), None)
        valid = at is not None and bool(state.valid[at])
        zones.append(
            {
                "field_deg": [float(angle) for angle in np.degrees(np.arctan(tangent))],
                "lit": float(array.lit[zone]),
                "valid": valid,
                "reason": windows.reasons[zone] if at is None else state.reasons[at],
                "wavefront_rms_rad": None,
                "wavefront_sigma_rad": None,
                "sharpness": float(sharp[at]) if at is not None and np.isfinite(sharp[at]) else None,
                "coefficients_rad": {noll: float(state.best_rad[at])} if valid and best else {noll: 0.0},
                "sigma_rad": {noll: float(state.sigma_rad[at])} if valid and best else {noll: None},
            }
        )
    known = [zone["sharpness"] for zone in zones if zone["valid"] and zone["sharpness"] is not None]
    return {
        "median": {"wavefront_rms_rad": None, "sharpness": float(np.median(known)) if known else 0.0},
        "worst": {"wavefront_rms_rad": None, "sharpness": float(np.min(known)) if known else 0.0},
        "zones": zones,
    }


def _degrees(state: State, at: int) -> str:
    """Return the direction of one of the zones looked at, x and y."""
    assert state.windows is not None
    x, y = np.degrees(np.arctan(array_of(state.spots).field_tan[state.windows.zones[at]]))
    return f"{x:+.1f}, {y:+.1f}"


def _figures(state: State, mosaics: Sequence[NDArray[np.float32]]) -> tuple[Figure, ...]:
    """Return the report's pictures: the contact sheet, the sharpness of its zones, the spots without and with."""
    assert state.windows is not None
    columns, noll, side = columns_of(state), state.parameters.sweep_noll, state.parameters.zones
    names = tuple(_degrees(state, at) for at in columns)
    middle = [at for at, zone in enumerate(state.windows.zones) if zone // state.parameters.zones == side // 2][:CURVES]
    curves = {f"zone at {_degrees(state, at)} deg": state.sharp[:, at] for at in middle}
    return (
        Figure(
            "contact-sheet",
            f"The spots with Noll {noll} added",
            "sheet",
            {
                "sheet": contact_sheet(state),
                "rows": state.coefficients_rad[::-1],
                "best": np.where(state.valid, state.best_rad, np.nan)[columns],
            },
            f"Noll {noll}, rad",
            f"A column per zone, each on one scale of grey (square root of the light, {TILE} camera pixels a cell). "
            "The marks stand at the coefficient at which it is sharpest.",
            labels=names,
        ),
        Figure(
            "sharpness",
            f"Sharpness against the coefficient of Noll {noll}",
            "curve",
            {"x": state.coefficients_rad, "median of all": np.nanmedian(state.sharp, axis=1), **curves},
            "sharpness",
            "x: radians over the whole pupil; zones of the middle row. 1: a perfect spot of the lit part of the pupil.",
        ),
        Figure(
            "spots",
            "The spots without the polynomial, and each with its best coefficient",
            "pair",
            {"without": mosaics[0], "with the best": mosaics[1]},
            "of each zone's brightest pixel",
            "One tile per zone, as they lie in the field; fresh frames. Empty: not lit, or not seen.",
        ),
    )
