"""Smooth functions of two variables as Chebyshev series: few samples make them, two products give a large grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from holocal.optics.bench import Array

_AT_A_TIME = 4096  # scattered points, whose powers stay in the cache


@dataclass(frozen=True)
class Series:
    """sum_ij coefficients[i, j] T_i(v) T_j(u), with u and v the coordinates scaled to [-1, 1] on a rectangle.

    `coefficients` (rows, columns, ...) may carry further axes: one series each. `centre` and `half` are (x, y).
    """

    coefficients: Array
    centre: tuple[float, float]
    half: tuple[float, float]

    def bases(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the basis at x and at y: (len(y), rows) and (len(x), columns); value = v @ coefficients @ u.T."""
        u, v = (x - self.centre[0]) / self.half[0], (y - self.centre[1]) / self.half[1]
        rows, columns = self.coefficients.shape[:2]
        return np.asarray(chebyshev.chebvander(v, rows - 1)), np.asarray(chebyshev.chebvander(u, columns - 1))

    def on_grid(self, x: Array, y: Array) -> Array:
        """Return the values, (len(y), len(x), ...), on the grid of x (w,) and y (h,)."""
        in_y, in_x = self.bases(x, y)
        return np.asarray(np.einsum("yi,ij...,xj->yx...", in_y, self.coefficients, in_x, optimize=True))

    def at(self, points: Array) -> Array:
        """Return the values, (n, ...), at scattered points (n, 2)."""
        rows, columns = self.coefficients.shape[:2]
        tables = np.moveaxis(self.coefficients.reshape(rows, columns, -1), -1, 0)
        values = np.empty((len(points), len(tables)))
        for first in range(0, len(points), _AT_A_TIME):
            part = slice(first, first + _AT_A_TIME)
            in_x = _chebyshev((points[part, 0] - self.centre[0]) / self.half[0], columns)
            in_y = _chebyshev((points[part, 1] - self.centre[1]) / self.half[1], rows)
            for k, table in enumerate(tables):
                values[part, k] = np.einsum("in,in->n", table @ in_x, in_y)
        return np.asarray(values.reshape(len(points), *self.coefficients.shape[2:]))

    def __add__(self, other: Series) -> Series:
        size = np.maximum(self.coefficients.shape, other.coefficients.shape)
        total = np.zeros(tuple(size))
        for one in (self.coefficients, other.coefficients):
            total[: one.shape[0], : one.shape[1]] += one
        return Series(total, self.centre, self.half)

    def times(self, factor: float) -> Series:
        """Return the series times a number."""
        return Series(self.coefficients * factor, self.centre, self.half)

    def __neg__(self) -> Series:
        return Series(-self.coefficients, self.centre, self.half)


def chebyshev_products(x: Array, y: Array, degree: int) -> Array:
    """Return T_i(x) T_j(y), i + j up to `degree`, at points with x (n,) and y (n,): (n, terms), j running faster."""
    in_x, in_y = chebyshev.chebvander(x, degree), chebyshev.chebvander(y, degree)
    return np.stack([in_x[:, i] * in_y[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)


def _chebyshev(x: Array, count: int) -> Array:
    """Return T_0 .. T_(count - 1) at x (n,), (count, n): five times as fast as numpy's, which runs across memory."""
    out: Array = np.empty((count, len(x)))
    out[0] = 1.0
    if count > 1:
        out[1] = x
    for k in range(2, count):
        np.multiply(out[k - 1], x, out=out[k])
        out[k] *= 2.0
        out[k] -= out[k - 2]
    return out


def fit_series(
    function: Callable[[Array], Array], *, degree: int, centre: tuple[float, float], half: tuple[float, float]
) -> Series:
    """Return the series that interpolates `function` at (degree + 1)^2 Chebyshev nodes.

    `function` takes points (n, 2) and returns (n, ...). The error is that of the first terms left out: compare two
    degrees to see it.
    """
    count = degree + 1
    node = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    grid = np.stack(np.meshgrid(node * half[0] + centre[0], node * half[1] + centre[1]), axis=-1)
    values = function(grid.reshape(-1, 2))
    values = values.reshape(count, count, *values.shape[1:])
    inverse = chebyshev.chebvander(node, degree).T * (2.0 / count)  # discrete orthogonality at the nodes
    inverse[0] /= 2.0
    coefficients = np.einsum("iy,yx...,jx->ij...", inverse, values, inverse, optimize=True)
    return Series(np.asarray(coefficients), centre, half)
