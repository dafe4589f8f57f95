"""Bases of a smooth map of the plane: a homography, Chebyshev products by total degree, tensor cubic B-splines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

Array = NDArray[np.float64]

CUBIC = 3
# Coefficients of 1, t, t^2, t^3 (rows) of the four cubic B-splines (columns) that an interval 0 <= t <= 1 meets.
_PIECES = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6


@dataclass(frozen=True)
class Box:
    """The rectangle of (u, v) that holds the data: `middle` (2,) and `half` (2,) its half sides, > 0."""

    middle: Array
    half: Array

    @classmethod
    def around(cls, points: Array) -> Box:
        """Return the smallest box round points (n, 2); a side is at least 1e-9 of the other."""
        low, high = points.min(axis=0), points.max(axis=0)
        half = (high - low) / 2
        return cls((low + high) / 2, np.maximum(half, max(1e-9 * half.max(), 1e-300)))

    def scaled(self, points: Array) -> Array:
        """Return points (..., 2) with the box as [-1, 1] along both axes."""
        return np.asarray((points - self.middle) / self.half)


def fit_homography(points: Array, places: Array, weight: Array) -> Array:
    """Return the homography (3, 3) from points (n, 2) to places (n, 2), n >= 4, by the normalised linear method.

    Hartley, "In defense of the eight-point algorithm", DOI 10.1109/34.601246. Its last element is positive, and 1
    unless the origin is on the line that goes to infinity.
    """
    to_points, to_places = _normaliser(points, weight), _normaliser(places, weight)
    p, q = apply_homography(to_points, points)[0], apply_homography(to_places, places)[0]
    root = np.sqrt(weight / max(float(weight.mean()), 1e-300))[:, None]
    one, zero = np.ones((len(p), 1)), np.zeros((len(p), 3))
    lifted = np.hstack([p, one])
    rows = np.vstack(
        [root * np.hstack([lifted, zero, -q[:, :1] * lifted]), root * np.hstack([zero, lifted, -q[:, 1:] * lifted])]
    )
    normal = rows.T @ rows
    found = np.linalg.eigh(normal)[1][:, 0].reshape(3, 3)
    whole = np.linalg.inv(to_places) @ found @ to_points
    last = whole[2, 2] if abs(whole[2, 2]) > 1e-12 * np.abs(whole).max() else 1.0
    return np.asarray(whole / last)


def apply_homography(homography: Array, points: Array) -> tuple[Array, Array]:
    """Return where points (n, 2) go, (n, 2), and the Jacobian (n, 2, 2), [i, j] = d place_i / d point_j."""
    lifted = points @ homography[:, :2].T + homography[:, 2]
    depth = lifted[:, 2:]
    places = lifted[:, :2] / depth
    jacobian = (homography[None, :2, :2] - places[:, :, None] * homography[2, :2]) / depth[:, :, None]
    return places, jacobian


def degrees(most: int) -> NDArray[np.int64]:
    """Return the exponents (terms, 2) of all products up to a total degree, sorted by it."""
    both = [(n - j, j) for n in range(most + 1) for j in range(n + 1)]
    return np.array(both, np.int64)


def chebyshev(scaled: Array, most: int) -> Array:
    """Return the products T_i(u) T_j(v) at points (n, 2), (n, terms), in the order of `degrees`."""
    i, j = degrees(most).T
    u, v = (_polynomials(scaled[:, axis], most) for axis in (0, 1))
    return u[:, i] * v[:, j]


def chebyshev_slopes(scaled: Array, most: int) -> Array:
    """Return the derivatives of `chebyshev`, (n, terms, 2), by the two scaled coordinates."""
    i, j = degrees(most).T
    (u, du), (v, dv) = ((_polynomials(s, most), _slopes(s, most)) for s in (scaled[:, 0], scaled[:, 1]))
    return np.stack([du[:, i] * v[:, j], u[:, i] * dv[:, j]], axis=-1)


@dataclass(frozen=True)
class SplineBasis:
    """Tensor products of uniform cubic B-splines on [-1, 1] x [-1, 1], `intervals` (2,) along the two axes.

    Points outside are moved to the border: what happens out there is not the basis's business.
    """

    intervals: tuple[int, int]

    @property
    def terms(self) -> int:
        """Number of products."""
        return (self.intervals[0] + CUBIC) * (self.intervals[1] + CUBIC)

    def values(self, scaled: Array) -> csr_matrix:
        """Return the products at points (n, 2), sparse (n, terms)."""
        return self._product(self._along(0, scaled, 0), self._along(1, scaled, 0))

    def slopes(self, scaled: Array) -> tuple[csr_matrix, csr_matrix]:
        """Return the products' derivatives by the two scaled coordinates, each sparse (n, terms)."""
        u, v = self._along(0, scaled, 0), self._along(1, scaled, 0)
        return self._product(self._along(0, scaled, 1), v), self._product(u, self._along(1, scaled, 1))

    @cached_property
    def roughness(self) -> Array:
        """The penalty (terms, terms): squared third differences along both axes (Eilers and Marx)."""
        n, m = (count + CUBIC for count in self.intervals)
        along = [np.diff(np.eye(k), n=min(3, k - 1), axis=0) for k in (n, m)]
        return np.asarray(np.kron(along[0].T @ along[0], np.eye(m)) + np.kron(np.eye(n), along[1].T @ along[1]))

    def _along(self, axis: int, scaled: Array, derivative: int) -> tuple[NDArray[np.int64], Array]:
        """Return the first of the four splines that are not 0 at each point, and their four values (n, 4)."""
        count = self.intervals[axis]
        at = (np.clip(scaled[:, axis], -1, 1) + 1) * (count / 2)
        first = np.clip(np.floor(at).astype(np.int64), 0, count - 1)
        t = at - first
        powers = np.stack([np.ones_like(t), t, t**2, t**3], axis=1)
        if derivative:
            powers = np.stack([np.zeros_like(t), np.ones_like(t), 2 * t, 3 * t**2], axis=1) * (count / 2)
        return first, powers @ _PIECES

    def _product(self, u: tuple[NDArray[np.int64], Array], v: tuple[NDArray[np.int64], Array]) -> csr_matrix:
        four = np.arange(CUBIC + 1)
        columns = (u[0][:, None] + four)[:, :, None] * (self.intervals[1] + CUBIC) + (v[0][:, None] + four)[:, None, :]
        values = u[1][:, :, None] * v[1][:, None, :]
        n = len(values)
        starts = np.arange(n + 1) * (CUBIC + 1) ** 2
        return csr_matrix((values.reshape(-1), columns.reshape(-1), starts), shape=(n, self.terms))


def _normaliser(points: Array, weight: Array) -> Array:
    """Return the similarity (3, 3) that brings points about the origin, at a rms distance of sqrt(2)."""
    middle = np.average(points, axis=0, weights=weight)
    size = float(np.sqrt(np.average(((points - middle) ** 2).sum(axis=1), weights=weight) / 2))
    scale = 1 / max(size, 1e-300)
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])


def _polynomials(x: Array, most: int) -> Array:
    return np.asarray(np.polynomial.chebyshev.chebvander(x, most))


def _slopes(x: Array, most: int) -> Array:
    """Return T_n'(x) = n U_(n-1)(x), (n, most + 1)."""
    out = np.zeros((len(x), most + 1))
    second = [np.ones_like(x), 2 * x]
    for n in range(1, most + 1):
        out[:, n] = n * second[n - 1]
        second.append(2 * x * second[-1] - second[-2])
    return out
