"""The image of the pupil on the panel: which pixels serve a virtual point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from holocal.hologram.scenes.points import Aperture
from holocal.optics.bench import Array

EDGE_M = 0.2e-3  # width of the footprint's soft edge, in the pupil; half way at the rim (decision 0004)


def transmission(pupil_m: Array, diameter_m: float, aperture: Aperture | None = None) -> Array:
    """Return A (...) in [0, 1] of the footprint at pupil points (..., 2): 1 inside, half at the rim, a cosine between.

    Within the pupil, and within `aperture` where one is given.
    """
    inside = _soft_disc(np.hypot(pupil_m[..., 0], pupil_m[..., 1]), diameter_m / 2)
    if aperture is None:
        return inside
    away = pupil_m - np.asarray(aperture.centre_m)
    return inside * _soft_disc(np.hypot(away[..., 0], away[..., 1]), aperture.diameter_m / 2)


def _soft_disc(radius_m: Array, rim_m: float) -> Array:
    return np.asarray(0.5 - 0.5 * np.sin(np.pi * np.clip((radius_m - rim_m) / EDGE_M, -0.5, 0.5)))


def row_spans(rim_m: Array, y_m: Array) -> tuple[Array, Array]:
    """Return where rows at y (h,) enter and leave a convex outline (n, 2): two (h,) arrays of x.

    Rows that miss it come back with the entry right of the exit.
    """
    following = np.roll(rim_m, -1, axis=0)
    x0, y0, x1, y1 = (v[:, None] for v in (*rim_m.T, *following.T))
    crosses = (np.minimum(y0, y1) <= y_m) & (y_m < np.maximum(y0, y1))
    height = np.where(crosses, y1 - y0, 1.0)
    x = x0 + (y_m - y0) * (x1 - x0) / height
    return (
        np.min(np.where(crosses, x, np.inf), axis=0, initial=np.inf),
        np.max(np.where(crosses, x, -np.inf), axis=0, initial=-np.inf),
    )


def sample_footprint(rim_m: Array, half_size_m: tuple[float, float], count: int = 12) -> tuple[Array, Array]:
    """Return points (n, 2) spread over the part of the footprint on the panel, and their areas (n,), summing to 1.

    Both are empty where the footprint misses the panel.
    """
    low = max(float(rim_m[:, 1].min()), -half_size_m[1])
    high = min(float(rim_m[:, 1].max()), half_size_m[1])
    if low >= high:
        return np.empty((0, 2)), np.empty(0)
    middle = (np.arange(count) + 0.5) / count
    y = low + middle * (high - low)
    left, right = row_spans(rim_m, y)
    left, right = np.maximum(left, -half_size_m[0]), np.minimum(right, half_size_m[0])
    kept = right > left
    x = left[kept, None] + middle * (right - left)[kept, None]
    points = np.stack([x, np.broadcast_to(y[kept, None], x.shape)], axis=-1).reshape(-1, 2)
    area = np.repeat((right - left)[kept], count)
    return points, area / area.sum() if area.size else area


def soft_span(x_m: Array, left_m: Array, right_m: Array, step_m: float) -> NDArray[np.float32]:
    """Return how much of each pixel lies between the spans' ends, (h, w) float32 in [0, 1].

    Edges are one pixel (`step_m`) soft, so that the footprint does not jump by whole pixels from zone to zone.
    """
    x = (x_m / step_m).astype(np.float32)[None, :]
    with np.errstate(invalid="ignore"):
        left = np.where(right_m > left_m, left_m / step_m - 0.5, 1e9).astype(np.float32)[:, None]
        right = np.where(right_m > left_m, right_m / step_m + 0.5, -1e9).astype(np.float32)[:, None]
    return np.asarray(np.clip(np.minimum(x - left, right - x), 0.0, 1.0))
