"""The distortion's result: numbers at spots that the map has not seen, the map both ways as channels, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.camera_lens import ideal_pixels, ideal_tangents, pixel_tan
from holocal.estimate.picture_map import FourCorners
from holocal.estimate.smooth_map import SmoothMap
from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Figure
from holocal.records.facts import CameraFacts
from holocal.units import DEGREE
from procedures._bench_light import PARAMETERS
from procedures._distortion_map import array_of, corners_of, map_of, measured, moved
from procedures._distortion_points import Places, dark_subtracted, places_of_pair

if TYPE_CHECKING:
    from procedures.distortion import State

Array = NDArray[np.float64]
Maps = dict[str, NDArray[np.float32]]

FEWEST_SEEN = 0.8  # of the verification's spots
GRID = 150  # of the exported maps, along the longer side: a bilinear reading of them is off by 0.001 px


def conclusion(state: State, frames: Sequence[Frame]) -> Conclusion:
    """Return the result from the map's frames and the verification's."""
    chosen, camera = state.parameters, state.facts.camera
    sent, places = measured(state)
    found = map_of(state, sent, places)
    array = array_of(state, 2)
    wanted = ideal_pixels(state.wanted_tan, camera)
    check = places_of_pair(
        array, [frame.counts for frame in frames], [frame.exposure_s for frame in frames], state.reference,
        wanted_tan=state.wanted_tan,
    )  # fmt: skip
    check = moved(state, 2, check)
    expected = array.on
    before = side_of(
        places.ideal_px - sent, places.found, int(np.concatenate([array_of(state, g).on for g in _grids(state)]).sum())
    )
    after = side_of(check.ideal_px - wanted, check.found, int(expected.sum()))
    met = after["rms_px"] <= chosen.target_rms_px and after["max_px"] <= chosen.target_max_px
    met = met and after["points_found"] >= FEWEST_SEEN * after["points_expected"]
    corners = corners_of(sent, places)
    left = np.linalg.norm((corners(sent) - places.ideal_px)[places.found], axis=1)
    sentence = (
        f"distance from where the picture should be: {before['rms_px']:.2f} -> {after['rms_px']:.3f} px rms (target "
        f"{chosen.target_rms_px:g}), at most {after['max_px']:.2f} px (target {chosen.target_max_px:g}), at "
        f"{after['points_found']} of {after['points_expected']} spots that the map has not seen: "
        f"{'met' if met else 'not met'}"
    )
    if chosen.mode == "grid":
        sentence += f"; four corners alone would leave {np.sqrt(np.mean(left**2)):.2f} px"
    maps, units = _maps(state, found)
    pictures = [
        dark_subtracted(picture, state.reference, float(exposure_s))
        for picture, exposure_s in (
            (state.pictures[0], state.exposures_s[0]),
            (frames[0].counts, frames[0].exposure_s),
        )
    ]
    half = np.degrees(np.asarray(camera.field_rad) / 2)
    extent = (-float(half[0]), float(half[0]), -float(half[1]), float(half[1]))
    return Conclusion(
        before=before,
        after=after,
        targets={"rms_px": chosen.target_rms_px, "max_px": chosen.target_max_px},
        targets_met=bool(met),
        sentence=sentence,
        maps=maps,
        before_map=np.asarray(pictures[0], np.float32),
        after_map=np.asarray(pictures[1], np.float32),
        map_units=units | {"before": "counts", "after": "counts"},
        map_metadata={"pixel_tan": pixel_tan(camera)},
        extent_deg=extent,
        sigma={"before": sigma_of(places.ideal_px - sent, places), "after": sigma_of(check.ideal_px - wanted, check)},
        extra={
            "mode": chosen.mode,
            "light_model": dict(zip(PARAMETERS, state.light_values.tolist(), strict=False)),
            "map": _model(found),
            "corners_only": {"rms_px": float(np.sqrt(np.mean(left**2))), "max_px": float(left.max())},
            "centroid_sigma_px": float(np.median(check.sigma_px[check.found])) if check.found.any() else None,
            "camera_geometry": {
                "rotation_deg": camera.rotation_rad / DEGREE,
                "k1": camera.k1,
                "k2": camera.k2,
                "known_from": "the rig's file: what it does not say is taken for the display's",
            },
            "exposures_s": [*state.exposures_s.tolist(), *(frame.exposure_s for frame in frames)],
            "checked": {
                "sent_tan": state.sent_tan[expected].tolist(),
                "wanted_tan": state.wanted_tan[expected].tolist(),
            },
            "rig_facts": {
                "panel_width": state.facts.slm.width,
                "panel_height": state.facts.slm.height,
                "pitch_m": state.facts.slm.pitch_m,
                "pupil_diameter_m": state.facts.pupil_diameter_m,
                "eye_relief_m": state.facts.eye_relief_m,
                "pixel_tan": pixel_tan(camera),
                "wavelength_nm": chosen.wavelength_nm,
            },
        },
        figures=_figures(
            pictures,
            _arrows(sent, places, camera),
            _arrows(wanted, check, camera),
            maps,
            extent,
            chosen.target_max_px,
        ),
    )


def _grids(state: State) -> range:
    return range(int(state.grids.max()) + 1)


def side_of(off: Array, found: NDArray[np.bool_], expected: int) -> dict[str, Any]:
    """Return `before` or `after`: distances (n, 2) of the spots found."""
    distance = np.linalg.norm(off[found], axis=1)
    if not len(distance):
        return {"rms_px": float("inf"), "max_px": float("inf"), "points_found": 0, "points_expected": expected}
    return {
        "rms_px": float(np.sqrt(np.mean(distance**2))),
        "max_px": float(distance.max()),
        "points_found": len(distance),
        "points_expected": expected,
    }


def sigma_of(off: Array, places: Places) -> dict[str, float]:
    """Return the standard errors of a side's numbers, from those of its spots in each coordinate."""
    distance, sigma = np.linalg.norm(off, axis=1)[places.found], places.sigma_px[places.found]
    if not len(distance):
        return {}
    # The spots are a sample of the field: of n distances the rms is known to 1 / (2 sqrt(n)) of itself.
    rms, count = float(np.sqrt(np.mean(distance**2))), len(distance)
    noise = float(np.sqrt(np.mean(sigma**2) / count))
    return {"rms_px": float(np.hypot(rms / (2 * np.sqrt(count)), noise)), "max_px": float(sigma[np.argmax(distance)])}


def _maps(state: State, found: SmoothMap | FourCorners) -> tuple[Maps, dict[str, str]]:
    """Return the map's channels over the camera's field, and their units.

    ``correction.shift_tan_*``: to be added to the tangents of what is to be seen, to get those that are sent;
    ``map.sent_tan_*`` is that sum. ``map.seen_tan_*``: where what is sent to a place is seen: an image is predistorted
    by reading it there. ``sigma_px``: of the map, in each coordinate.
    """
    camera = state.facts.camera
    scale = GRID / max(camera.width, camera.height)
    width, height = max(round(camera.width * scale), 2), max(round(camera.height * scale), 2)
    columns = (np.arange(width) + 0.5) / width * camera.width - 0.5
    rows = (np.arange(height) + 0.5) / height * camera.height - 0.5
    at = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    here = ideal_tangents(at, camera)
    sent_px, sure = found.inverse(at)
    sent, seen = ideal_tangents(sent_px, camera), ideal_tangents(found(at), camera)
    made = {
        "correction.shift_tan_x": (sent - here)[:, 0],
        "correction.shift_tan_y": (sent - here)[:, 1],
        "map.sent_tan_x": sent[:, 0],
        "map.sent_tan_y": sent[:, 1],
        "map.seen_tan_x": seen[:, 0],
        "map.seen_tan_y": seen[:, 1],
        "sigma_px": found.sigma_px(sent_px),
        "valid": sure.astype(np.float64),
    }
    maps = {name: values.reshape(height, width).astype(np.float32) for name, values in made.items()}
    return maps, {name: "px" if name == "sigma_px" else "1" for name in maps}


def _model(found: SmoothMap | FourCorners) -> dict[str, Any]:
    """Return the map's model, from ideal pixels to ideal pixels, as numbers."""
    if isinstance(found, FourCorners):
        return {"kind": "homography", "homography": np.asarray(found.matrix).tolist()}
    return {
        "kind": "homography, then Chebyshev products of a total degree"
        + ("" if found.spline is None else ", then a spline (in the exported channels only)"),
        "homography": found.homography.tolist(),
        "degree": found.degree,
        "box_middle": np.asarray(found.box.middle).tolist(),
        "box_half": np.asarray(found.box.half).tolist(),
        "coefficients_px": found.coefficients.tolist(),
        "spline": found.spline is not None,
        "noise_px": found.noise_px,
        "holdout_rms_px": found.holdout_rms_px,
        "outliers": int(np.count_nonzero(found.outlier)),
    }


def _arrows(wanted_px: Array, places: Places, camera: CameraFacts) -> NDArray[np.float32]:
    """Return the spots found, (n, 4): x and y wanted in degrees, and how far right and up they are seen, pixels."""
    wanted, off = wanted_px[places.found], (places.ideal_px - wanted_px)[places.found]
    return np.column_stack([np.degrees(np.arctan(ideal_tangents(wanted, camera))), off * [1, -1]]).astype(np.float32)


def _without_mean(arrows: NDArray[np.float32]) -> NDArray[np.float32]:
    return arrows - np.concatenate([np.zeros(2), arrows[:, 2:].mean(axis=0)]).astype(np.float32)


def _figures(
    pictures: list[Array],
    before: NDArray[np.float32],
    after: NDArray[np.float32],
    maps: Maps,
    extent: tuple[float, float, float, float],
    limit_px: float,
) -> tuple[Figure, ...]:
    """Return the report's pictures: the spots, how far off they are, the map's shift and its error."""
    brightest = [max(float(np.quantile(one, 0.9995)), 1.0) for one in pictures]
    shown = [np.clip(one / top, 0, 1).astype(np.float32) for one, top in zip(pictures, brightest, strict=True)]
    off_px = np.linalg.norm(after[:, 2:], axis=1)
    return (
        Figure(
            "spots", "The spots, as sent and through the map", "pair", {"before": shown[0], "after": shown[1]},
            "of the brightest", "The camera's pictures; before: the first grid, after: the verification's.",
        ),
        Figure(
            "off_after", "Distance of the verification's spots from where they should be", "histogram",
            {"values": off_px}, "px", f"{len(off_px)} spots that the map has not seen.", target=limit_px,
        ),
        Figure(
            "arrows", "From where spots should be to where they are seen", "vectors",
            {"before": before, "before, but for the mean shift": _without_mean(before), "after": after}, "px",
            "Each panel has a scale of its own: its bar is as long as it says in camera pixels. Before: the spots of "
            "the map. After: the verification's.", extent,
        ),
        Figure(
            "shift", "How far the map moves what is sent", "map",
            {"values": np.hypot(maps["correction.shift_tan_x"], maps["correction.shift_tan_y"]) * np.float32(1e3)},
            "mrad", "Length of the shift; its parts are the channels correction.shift_tan_x and _y.", extent,
        ),
        Figure(
            "sigma", "Standard error of the map", "map", {"values": maps["sigma_px"]}, "px",
            "Of each coordinate; it grows where no spot was seen.", extent,
        ),
    )  # fmt: skip
