"""Which triangle is seen in which direction: a z-buffer over an image's pixels.

A direction d = (t, 1) meets the plane of a triangle (v0, v1, v2) at z d, where v0, v1, v2 weigh b0, b1, b2. Since
z d = sum b_i v_i, the quotients u_i = b_i / z = d . (v_j x v_k) / (v0 . (v1 x v2)) are linear in t; so is their sum
1 / z; and the direction is inside where none is negative (Olano and Greer 1997, DOI 10.1145/258694.258723). Nothing is
divided by a vertex's z, so a triangle may pass behind the eye: clipping (Sutherland and Hodgman) at `NEAREST_M` only
bounds the pixels that are tried, and hits nearer than that are dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.hologram.scenes.cloud import Directions
from holocal.optics.bench import Array

Indices = NDArray[np.int64]

NEAREST_M = 0.01
_AT_ONCE = 1 << 19  # pairs of triangle and pixel: 8 arrays of 4 MB
_EDGE = 1e-9  # of a triangle's size: neighbours leave no crack between them


@dataclass(frozen=True)
class Seen:
    """What is seen in the `n` directions that meet a triangle.

    `row`, `column` (n,) of the pixel; `triangle` (n,) index; `weight` (n, 3) of its vertices; `depth_m` (n,) z.
    """

    row: Indices
    column: Indices
    triangle: Indices
    weight: Array
    depth_m: Array


def seen(corners: Array, directions: Directions, *, back_faces: bool = True) -> Seen:
    """Return the nearest triangle in each direction.

    Parameters
    ----------
    corners
        (m, 3, 3): triangle, corner, (x, y, z) in P, metres. Triangles seen edge-on are not seen.
    directions
        The pixels.
    back_faces
        Also triangles whose corners run clockwise as seen from the pupil (in P's right-handed axes).
    """
    v0, v1, v2 = corners[:, 0], corners[:, 1], corners[:, 2]
    # v_j x v_k written with differences, which a small triangle far away needs
    across = np.stack([np.cross(v1, v2 - v1), np.cross(v2, v0 - v2), np.cross(v0, v1 - v0)], axis=1)
    volume = np.sum(v0 * across[:, 0], axis=-1)
    facing = volume != 0 if back_faces else volume < 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        slopes = across / volume[:, None, None]  # u_i = slopes[i] . (t, 1)
    usable = facing & np.isfinite(slopes).all(axis=(1, 2))
    rows, columns = directions.shape
    nearest = np.zeros(rows * columns)  # 1 / z
    winner = np.full(rows * columns, -1, np.int64)
    for triangle, pixel in _candidates(corners, usable, directions):
        t = np.stack([directions.x_tan[pixel % columns], directions.y_tan[pixel // columns]])
        quotients = _quotients(slopes, triangle, t)
        inverse = quotients[0] + quotients[1] + quotients[2]
        inside = (np.minimum.reduce(quotients) >= -_EDGE * inverse) & (inverse > 0) & (inverse <= 1 / NEAREST_M)
        triangle, pixel, inverse = triangle[inside], pixel[inside], inverse[inside]
        np.maximum.at(nearest, pixel, inverse)
        first = inverse == nearest[pixel]
        winner[pixel[first]] = triangle[first]
    pixel = np.flatnonzero(winner >= 0)
    row, column, triangle = pixel // columns, pixel % columns, winner[pixel]
    quotients = _quotients(slopes, triangle, np.stack([directions.x_tan[column], directions.y_tan[row]]))
    weight = np.maximum(np.stack(quotients, axis=-1), 0)
    return Seen(row, column, triangle, weight / weight.sum(axis=-1, keepdims=True), 1 / nearest[pixel])


def _quotients(slopes: Array, triangle: Indices, t: Array) -> list[Array]:
    """Return b_i / z, i = 0, 1, 2, each (n,)."""
    return [slopes[triangle, i, 0] * t[0] + slopes[triangle, i, 1] * t[1] + slopes[triangle, i, 2] for i in range(3)]


def _candidates(corners: Array, usable: NDArray[np.bool_], directions: Directions) -> Iterator[tuple[Indices, Indices]]:
    """Yield pairs (triangle, pixel), `_AT_ONCE` or one triangle's at a time: each triangle with its bounding box."""
    low, high = _bounds(corners)
    left = np.searchsorted(directions.x_tan, low[:, 0], "left")
    right = np.searchsorted(directions.x_tan, high[:, 0], "right")
    top = np.searchsorted(-directions.y_tan, -high[:, 1], "left")
    bottom = np.searchsorted(-directions.y_tan, -low[:, 1], "right")
    width = np.maximum(right - left, 0)
    count = np.where(usable, width * np.maximum(bottom - top, 0), 0)
    order = np.flatnonzero(count)
    ends = np.cumsum(count[order])
    start = 0
    while start < len(order):
        before = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, before + _AT_ONCE, "right")), start + 1)
        some = order[start:stop]
        triangle = np.repeat(some, count[some])
        place = np.arange(len(triangle)) - np.repeat(ends[start:stop] - count[some] - before, count[some])
        row, column = np.divmod(place, width[triangle])
        yield triangle, (top[triangle] + row) * len(directions.x_tan) + left[triangle] + column
        start = stop


def _bounds(corners: Array) -> tuple[Array, Array]:
    """Return the smallest and the largest tangents (m, 2) of what is left of each triangle in front of `NEAREST_M`."""
    following = np.roll(corners, -1, axis=1)
    z, next_z = corners[..., 2], following[..., 2]
    crosses = (z > NEAREST_M) != (next_z > NEAREST_M)
    share = np.where(crosses, (NEAREST_M - z) / np.where(crosses, next_z - z, 1), 0)
    cut = corners + share[..., None] * (following - corners)  # where an edge passes the near plane
    cut[..., 2] = NEAREST_M
    points = np.concatenate([corners, cut], axis=1)
    there = np.concatenate([z > NEAREST_M, crosses], axis=1)[..., None]
    tangents = points[..., :2] / np.where(there, points[..., 2:], 1)
    low = np.where(there, tangents, np.inf).min(axis=1)
    high = np.where(there, tangents, -np.inf).max(axis=1)
    room = _EDGE * np.maximum(np.abs(low), np.abs(high))
    with np.errstate(invalid="ignore"):
        return low - room, high + room
