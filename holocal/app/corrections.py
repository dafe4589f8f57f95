"""Accepted maps applied to a scene: brightness is divided out of the image's intensity."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.records.calibration import Accepted
from holocal.units import DEGREE

UNIFORMITY = "uniformity"
WEIGHT = "correction.intensity_weight"


def corrected(
    intensity: NDArray[np.float32],
    accepted: Mapping[str, Accepted],
    *,
    fov_rad: tuple[float, float],
    gaze_rad: tuple[float, float],
) -> NDArray[np.float32]:
    """Return a scene's intensity, (height, width), times the accepted brightness weight at each pixel's direction.

    The scene covers `fov_rad` about `gaze_rad` and the map its own ``extent_deg``; both are rectilinear (pixels are
    evenly spaced in the tangent of the angle), row 0 on top. Beyond the map its edge value holds. A weight is in
    (0, 1]; without an accepted uniformity the scene comes back as it is.
    """
    found = accepted.get(UNIFORMITY)
    if found is None:
        return intensity
    weight, extent = found.maps.channels.get(WEIGHT), found.maps.extent_deg
    if weight is None or extent is None:
        raise InputError(
            f"the uniformity calibration {found.entry} has no channel {WEIGHT} with an extent.",
            fix="Measure it again, or use `--corrections none`.",
        )
    rows, columns = intensity.shape
    x = _tangents(columns, fov_rad[0], gaze_rad[0])
    y = _tangents(rows, fov_rad[1], gaze_rad[1])[::-1]  # row 0 is the top
    left, right, bottom, top = (np.tan(angle * DEGREE) for angle in extent)
    height, width = weight.shape
    column = (x - left) / (right - left) * width - 0.5
    row = (top - y) / (top - bottom) * height - 0.5
    weighted: NDArray[np.float32] = np.asarray(intensity * _bilinear(weight, row, column), np.float32)
    return weighted


def _tangents(count: int, full_rad: float, centre_rad: float) -> NDArray[np.float64]:
    half = np.tan(full_rad / 2)
    return np.asarray(np.tan(centre_rad) + half * (2 * np.arange(count) + 1 - count) / count)


def _bilinear(
    values: NDArray[np.float32], row: NDArray[np.float64], column: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return `values` on the grid of (row, column), separably, edges held."""
    return np.asarray(_along(_along(values.astype(np.float64), row).T, column).T)


def _along(values: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    last = values.shape[0] - 1
    clipped = np.clip(at, 0, last)
    low = np.minimum(np.floor(clipped).astype(int), max(last - 1, 0))
    part = (clipped - low)[:, None]
    return np.asarray((1 - part) * values[low] + part * values[np.minimum(low + 1, last)])
