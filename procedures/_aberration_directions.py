"""Which direction every pixel of a zone's window looks at: from where the spots are seen, and how the light bends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.spot_model import PupilBox, Window
from holocal.estimate.spot_places import SpotPlaces
from holocal.estimate.zone_data import ZoneFit
from procedures._aberration_spots import EDGE_M, SpotArray, soft_disc

Array = NDArray[np.float64]

MARGIN_PX = 5  # of a window round a spot: what an aberration of 4 rad throws out
LEAST_INSIDE_PX = 3  # of a spot's middle from the picture's edge
WELL_PLACED = 9  # zones whose fits place them: from as many on the map between is known
WELL_PLACED_CHI2 = 3.0  # times the median: a fit that is no worse places its spot


def windows_of(array: SpotArray, places: SpotPlaces) -> tuple[list[Window | None], list[str]]:
    """Return every zone's window, and a sentence for each that has none."""
    camera = array.facts.camera
    found: list[Window | None] = []
    reasons = []
    jacobians = places.jacobian(places.places)
    for zone in range(len(array.field_tan)):
        window, reason = None, ""
        if not array.on[zone]:
            reason = f"the panel lights {array.lit[zone]:.1%} of the pupil: too little to measure"
        else:
            extent = array.bend_per_m[zone] * array.half_m[zone] / array.pixel_tan
            spread = array.wavelength_m / (2 * array.half_m[zone]) / array.pixel_tan
            half = np.ceil(extent + 0.6 * np.minimum(spread, 15.0) + MARGIN_PX).astype(int)
            column, row = (round(float(v)) for v in places.seen[zone])
            least = np.minimum(half, LEAST_INSIDE_PX)  # beyond the picture's edge a window has no good pixels
            inside = least[0] <= column < camera.width - least[0] and least[1] <= row < camera.height - least[1]
            if inside:
                window = window_at(array, zone, (column, row), (int(half[0]), int(half[1])), jacobians[zone])
            else:
                reason = f"its spot is seen at column {column}, row {row}: outside the picture"
        found.append(window)
        reasons.append(reason)
    return found, reasons


def window_at(array: SpotArray, zone: int, centre: tuple[int, int], half: tuple[int, int], jacobian: Array) -> Window:
    """Return a zone's window; `jacobian` (2, 2) is d seen / d place in (columns, rows down), both in pixels.

    k q . ds is the same phase in the nominal bench's directions and in the camera's own, so that what stretches a
    picture squeezes the pupil: the rim of a true pupil is known in the nominal one's places.
    """
    near = array.nearby
    own = directions(array, array.field_tan[zone], np.eye(2))
    linear = directions(array, array.field_tan[zone], jacobian)
    return Window(
        *centre,
        half,
        linear,
        near.relief_m[zone],
        near.relief_slope[zone],
        curve_of(array, zone, jacobian, linear),
        2 * linear.T @ near.envelope[zone],
        np.linalg.inv(own).T @ linear.T,
        near.block_m[zone],
    )


def directions(array: SpotArray, tangent: Array, jacobian: Array) -> Array:
    """Return what takes pixels (right, up) to direction sines of the nominal bench, (2, 2)."""
    sines = tangent / np.sqrt(1 + tangent @ tangent)
    per_tangent = (np.eye(2) - np.outer(sines, sines)) / np.sqrt(1 + tangent @ tangent)
    return np.asarray(per_tangent @ _to_tangent(array, jacobian))


def curve_of(array: SpotArray, zone: int, jacobian: Array, linear: Array) -> Array:
    """Return the second order of what `directions` (`linear`) is the first of, (2, 3) as `Window.curve` has it.

    A rectilinear camera's pixels are tangents, not sines. And the light from a place of the panel moves over the pupil
    with its direction; where that relief R differs over the pupil, its phase k q . ds becomes
    k q . (ds + ds (dR / dq) ds / 2): a picture bent by as much.
    """
    line = np.linspace(-10, 10, 7)
    offset = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    tangent = array.field_tan[zone] + offset @ _to_tangent(array, jacobian).T
    turned = _sines(tangent) - _sines(array.field_tan[zone])
    turned = turned + 0.5 * np.einsum("ni,ijk,nj->nk", turned, array.nearby.relief_slope[zone], turned)
    left = turned @ np.linalg.inv(linear).T - offset
    x, y = offset.T
    terms = np.stack([x, y, x * x, x * y, y * y], axis=-1)
    return np.asarray(np.linalg.lstsq(terms, left, rcond=None)[0][2:].T)


def _to_tangent(array: SpotArray, jacobian: Array) -> Array:
    """Return what takes pixels (right, up), as seen, to tangents of the nominal bench."""
    flip = np.diag([1.0, -1.0])
    return np.asarray(flip @ np.linalg.inv(jacobian) @ flip * array.pixel_tan)


def _sines(tangent: Array) -> Array:
    return np.asarray(tangent / np.sqrt(1 + np.sum(tangent**2, axis=-1, keepdims=True)))


def lit_grid(array: SpotArray, zone: int, pupil_m: Array) -> tuple[Array, Array]:
    """Return points (n, 2) of a zone's lit pupil and the root of their weight, the weights' sum being 1.

    `pupil_m` (2,) is where the pupil lies; a hologram of the nominal bench fills its own place for it.
    """
    side = np.linspace(-1, 1, 31)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) * array.half_m[zone] + array.centre_m[zone]
    radius = array.facts.pupil_diameter_m / 2
    weight = (soft_disc(grid, radius, EDGE_M) * soft_disc(grid - pupil_m, radius, EDGE_M)) ** 2
    return grid, np.sqrt(weight / max(float(weight.sum()), 1e-300))


def placed(
    array: SpotArray,
    places: SpotPlaces,
    windows: Sequence[Window | None],
    boxes: Sequence[PupilBox | None],
    fits: Sequence[ZoneFit | None],
    degree: int,
    pupil_m: Array,
) -> SpotPlaces | None:
    """Return the map of the spots' places by the tilt of their fitted wavefronts; None from too few zones.

    Centroids are off by tenths of a pixel: the light of a spot is uneven. That makes the map's slope, which is what a
    pixel's direction is, wrong by percents at the field's edge, and 1 % of it is 1 % of the known defocus.
    """
    seen, known = places.seen.copy(), np.zeros(len(windows), np.bool_)
    good = [fit.chi2 for fit in fits if fit is not None]
    if len(good) < WELL_PLACED:
        return None
    limit = WELL_PLACED_CHI2 * max(float(np.median(good)), 1.0)
    k = 2 * np.pi / array.wavelength_m
    for zone, (window, box, fit) in enumerate(zip(windows, boxes, fits, strict=True)):
        if window is None or box is None or fit is None or fit.chi2 > limit:
            continue
        grid, root = lit_grid(array, zone, pupil_m)
        wavefront = box.legendre(grid, degree)[:, 1:] @ fit.wavefront_rad
        plane = np.concatenate([np.ones((len(grid), 1)), grid * 1e3], axis=1) * root[:, None]
        slope = 1e3 * np.linalg.lstsq(plane, wavefront * root, rcond=None)[0][1:]
        right, up = np.linalg.solve(window.direction, -slope / k)
        seen[zone] = window.column + right, window.row - up
        known[zone] = True
    return places.moved(seen, known) if np.count_nonzero(known) >= WELL_PLACED else None


def turned(array: SpotArray, windows: Sequence[Window | None], jacobians: Array) -> list[Window | None]:
    """Return the same pixels' windows with other directions, `jacobians` (zones, 2, 2)."""
    return [
        None if window is None else window_at(array, zone, (window.column, window.row), window.half, jacobians[zone])
        for zone, window in enumerate(windows)
    ]


def better_jacobians(
    array: SpotArray,
    places: SpotPlaces,
    windows: Sequence[Window | None],
    boxes: Sequence[PupilBox | None],
    fits: Sequence[ZoneFit | None],
    degree: int,
    pupil_m: Array,
) -> tuple[Array, bool] | None:
    """Return the zones' (2, 2) d seen / d place as the fits have it, and whether many zones say so; None if none does.

    Many zones place a curved map. Of a few the pictures' own stretch is taken, the median, over the map that there is.
    """
    mapped = placed(array, places, windows, boxes, fits, degree, pupil_m)
    if mapped is not None:
        return mapped.jacobian(mapped.places), True
    own = [fit.vector[fit.layout.affine].reshape(2, 2) for fit in fits if fit is not None]
    if not own:
        return None
    flip = np.diag([1.0, -1.0])
    stretch = flip @ np.linalg.inv(np.eye(2) - np.median(own, axis=0)) @ flip
    return stretch @ places.jacobian(places.places), False
