"""The result of `uniformity`: numbers, maps and pictures, and the thesis's estimator beside ours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.thesis_map import at_size, thesis_map
from holocal.estimate.uniformity import Uniformity, inscribed_rectangle, measure_uniformity
from holocal.loop.procedure import Conclusion, Figure
from procedures._uniformity_geometry import as_seen

if TYPE_CHECKING:
    from procedures.uniformity import State

Image = NDArray[np.float32]


def thesis_weights(state: State, shown: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the weights that the thesis's method gives: the last weights as seen, over the map of what they showed.

    The map is made of the last frame alone, as the thesis has it, and floored where it is below `floor` of its largest.
    """
    height, width = valid.shape
    seen = at_size(thesis_map(state.frames[-1]), height, width)
    floor = max(float(seen[valid].min()), state.parameters.floor * float(seen[valid].max()))
    weights = shown / np.maximum(seen, floor)
    return np.asarray(np.minimum(weights / weights[valid].max(), 1.0))


def beside_thesis(state: State, verified: Image, block_px: int) -> dict[str, float]:
    """Return what the thesis's estimator, given the same white frames, would have left.

    Its map is made from the mean of the white frames (`thesis_mean`) and from the first alone (`thesis_single`, as in
    the thesis). The picture that its weights would give is the verification's, times the ratio of its weights to those
    shown, to the power of the fitted response.
    """
    assert state.valid is not None
    assert state.registration is not None
    valid = state.valid
    corrected = as_seen(state.weights[-1], state.registration)
    white = state.frames[[shown == 0 for shown in state.shown]]
    out = {}
    for name, frame in (("thesis_mean", white.mean(axis=0)), ("thesis_single", white[0])):
        seen = at_size(thesis_map(frame), *valid.shape)
        ratio = (1 / np.maximum(seen, 0.05 * seen.max()) / corrected) ** state.gamma
        ratio /= ratio[valid].mean()
        found = _measured(verified * ratio, valid, block_px=block_px)
        out[f"{name}_nonuniformity_rms"] = found.rms
        out[f"{name}_nonuniformity_9pt"] = found.nine_point
    return out


def _measured(pictures: Image, valid: NDArray[np.bool_], *, block_px: int) -> Uniformity:
    return measure_uniformity(np.asarray(pictures, np.float64), valid, block_px=block_px)


def _numbers(found: Uniformity, light: float) -> dict[str, float]:
    return {"nonuniformity_rms": found.rms, "nonuniformity_9pt": found.nine_point, "light_fraction": light}


def conclusion(state: State, verified: Image) -> Conclusion:
    """Return the conclusion from the final state and the verification's frames (n, height, width)."""
    assert state.valid is not None
    assert state.brightness is not None
    assert state.sigma is not None
    assert state.registration is not None
    chosen, valid = state.parameters, state.valid
    white = state.frames[[shown == 0 for shown in state.shown]]
    before = _measured(white, valid, block_px=chosen.block_px)
    after = _measured(verified, valid, block_px=chosen.block_px)
    light = after.mean / before.mean
    met = after.rms <= chosen.target_rms and after.nine_point <= chosen.target_9pt
    correctable = float(valid.mean())
    sentence = (
        f"non-uniformity {before.rms:.3f} -> {after.rms:.4f} +- {after.rms_sigma:.4f} (target {chosen.target_rms:g}), "
        f"nine points {before.nine_point:.3f} -> {after.nine_point:.3f} (target {chosen.target_9pt:g}), over "
        f"{correctable:.0%} of the picture, with {light:.0%} of the light: {'met' if met else 'not met'}"
    )
    maps: dict[str, Image] = {
        "brightness": state.brightness,
        "brightness_sigma": state.sigma,
        "correction.intensity_weight": state.weights[-1],
        "valid": valid.astype(np.float32),
    }
    half = [float(np.degrees(angle) / 2) for angle in state.facts.camera.field_rad]
    extent = (-half[0], half[0], -half[1], half[1])
    first, last = white.mean(axis=0), verified.mean(axis=0)
    return Conclusion(
        before=_numbers(before, 1.0),
        after=_numbers(after, light),
        targets={"nonuniformity_rms": chosen.target_rms, "nonuniformity_9pt": chosen.target_9pt},
        targets_met=met,
        sentence=sentence,
        maps=maps,
        before_map=first,
        after_map=last,
        map_units={"brightness": "1", "brightness_sigma": "1", "correction.intensity_weight": "1", "valid": "1"},
        extent_deg=extent,
        sigma={
            "before": {"nonuniformity_rms": before.rms_sigma, "nonuniformity_9pt": before.nine_point_sigma},
            "after": {"nonuniformity_rms": after.rms_sigma, "nonuniformity_9pt": after.nine_point_sigma},
        },
        extra={
            "estimator": chosen.estimator,
            "thesis": beside_thesis(state, verified, chosen.block_px),
            "response_exponent": {"mean": state.gamma, "sigma": state.gamma_sigma},
            "map_sigma_rms": state.map_sigma,
            "correctable_fraction": correctable,
            "registration": {
                "shift_px": list(state.registration.shift_px),
                "residual_px": state.registration.residual_px,
                "blobs_found": state.registration.found,
                "blobs_shown": state.registration.shown,
            },
            "exposure_s": state.exposure_s,
        },
        figures=_figures(state, first, last, extent),
    )


def _figures(
    state: State, before: Image, after: Image, extent: tuple[float, float, float, float]
) -> tuple[Figure, ...]:
    """Return the report's pictures: before and after on one scale, their cross-sections, the map, its error."""
    assert state.valid is not None
    assert state.brightness is not None
    assert state.sigma is not None
    valid = state.valid
    scale = np.float32(1 / before[valid].mean())
    top, bottom, *_ = inscribed_rectangle(valid)
    row = (top + bottom) // 2
    reach = state.parameters.block_px // 2
    x = np.linspace(extent[0], extent[1], valid.shape[1])
    band = slice(max(row - reach, 0), row + reach + 1)
    kernel = np.ones(2 * reach + 1) / (2 * reach + 1)
    cuts: dict[str, Any] = {"x": x}
    for name, picture in (("before", before), ("after", after)):
        line = (picture[band] * scale).mean(axis=0)
        cuts[name] = np.where(valid[row], np.convolve(line, kernel, mode="same"), np.nan)
    mask = valid.astype(np.float32)
    title = f"Brightness along the row through the middle ({2 * reach + 1} rows and columns averaged)"
    return (
        Figure(
            "field",
            "The white field before and after",
            "pair",
            {"before": before * scale, "after": after * scale, "valid": mask},
            "of the mean before",
            "Mean of the frames; the grain is speckle. Beyond the border the field is too faint to be corrected.",
            extent,
        ),
        Figure("cut", title, "curve", cuts, "of the mean before", "x: field angle in degrees", extent),
        Figure(
            "map",
            "The bench's own brightness",
            "map",
            {"brightness": state.brightness, "valid": mask},
            "of the brightest",
            "Estimated from all frames together.",
            extent,
        ),
        Figure(
            "weight",
            "What the image is multiplied by",
            "map",
            {"weight": state.weights[-1]},
            "intensity",
            "The correction that `accept` puts in force, in the image's own directions.",
            extent,
        ),
        Figure(
            "sigma",
            "How well the map is known",
            "map",
            {"sigma": state.sigma, "valid": mask},
            "relative, 1 sigma",
            "Standard error of the map's shape.",
            extent,
        ),
    )
