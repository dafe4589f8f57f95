"""The wave's phase between a patch of the panel and the pupil, as polynomials.

From the panel point x to the pupil point q the light's phase is k L(x, q), with L the length of the traced ray. Over a
small patch of the panel it is, to about 0.02 rad (rms, 384 x 360 pixels, whole pupil), the sum of a function of x, one
of q, and two products u(q) g(x). The four are found from the ray trace by a singular value decomposition, so nothing
here knows how the hologram engine thinks of the same bench: that one works between panel and field, this one between
panel and pupil, where the pupil is an exact mask.
What is left of it `stencil` makes up for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev

from holocal.errors import ConfigError
from holocal.optics.bench import Array, Bench
from holocal.optics.raytrace import connect

# Chebyshev nodes per axis: with these the interpolation is below 1e-3 rad (tests/physics/test_simulated_bench.py)
PANEL_NODES, X_NODES, Q_NODES = 13, 7, 13


@dataclass(frozen=True)
class Box:
    """A rectangle (x low, x high, y low, y high), metres; polynomials are Chebyshev in its normalised coordinates."""

    x0: float
    x1: float
    y0: float
    y1: float

    def normalise(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return x and y scaled to [-1, 1]."""
        return (2 * x - self.x0 - self.x1) / (self.x1 - self.x0), (2 * y - self.y0 - self.y1) / (self.y1 - self.y0)

    def nodes(self, n: int) -> tuple[Array, Array]:
        """Return n ascending Chebyshev nodes along x and along y."""
        t = -np.cos(np.pi * (np.arange(n) + 0.5) / n)
        centre_x, centre_y = (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2
        return centre_x + t * (self.x1 - self.x0) / 2, centre_y + t * (self.y1 - self.y0) / 2


@dataclass(frozen=True)
class Polynomial:
    """A Chebyshev polynomial in two variables over a box; `coefficients` (y order, x order)."""

    box: Box
    coefficients: Array

    def on_grid(self, x: Array, y: Array) -> Array:
        """Return its values, (len(y), len(x)) float64, on the product grid of x and y."""
        nx, ny = self.box.normalise(x, y)
        order_y, order_x = self.coefficients.shape
        basis_y = chebyshev.chebvander(ny, order_y - 1)
        basis_x = chebyshev.chebvander(nx, order_x - 1)
        return np.asarray(basis_y @ self.coefficients @ basis_x.T)

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return its derivatives along x and along y, (len(y), len(x)) each, on the product grid of x and y."""
        across, down = (np.asarray(chebyshev.chebder(self.coefficients, axis=i), np.float64) for i in (1, 0))
        along_x = Polynomial(self.box, across * (2 / (self.box.x1 - self.box.x0)))
        along_y = Polynomial(self.box, down * (2 / (self.box.y1 - self.box.y0)))
        return along_x.on_grid(x, y), along_y.on_grid(x, y)

    def __sub__(self, other: Polynomial) -> Polynomial:
        return Polynomial(self.box, self.coefficients - other.coefficients)


def interpolate(box: Box, values: Array) -> Polynomial:
    """Return the polynomial through values (n, n) at the box's Chebyshev nodes (rows along ascending y)."""
    n = values.shape[0]
    t = -np.cos(np.pi * (np.arange(n) + 0.5) / n)
    inverse = np.linalg.inv(chebyshev.chebvander(t, n - 1))
    return Polynomial(box, inverse @ values @ inverse.T)


@dataclass(frozen=True)
class PatchKernel:
    """Phase k L(x, q) = alpha(x) + beta(q) + u(q) . g(x), radians, over one patch; `residual_rad`: what it leaves, rms.

    `alpha`, `gx`, `gy` are polynomials over the patch (`g` in metres, close to x - patch centre), `beta`, `ux`, `uy`
    (u in radians per metre) over the pupil. At the nodes of both, (panel nodes, pupil nodes): `rest_rad` is what the
    form leaves, `amplitude` the square root of |det d2L/dx dq| (per metre), `fx` and `fy` the spatial frequencies
    (cycles per metre) of the light that leaves x for q.
    """

    alpha: Polynomial
    gx: Polynomial
    gy: Polynomial
    beta: Polynomial
    ux: Polynomial
    uy: Polynomial
    amplitude: Array
    fx: Array
    fy: Array
    rest_rad: Array
    residual_rad: float


def _grid(box: Box, n: int) -> Array:
    x, y = box.nodes(n)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _interpolation(nodes: int, at: Array) -> Array:
    """Return the matrix (len(at), nodes) that takes values at ascending Chebyshev nodes of [-1, 1] to points `at`."""
    t = -np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)
    return np.asarray(chebyshev.chebvander(at, nodes - 1) @ np.linalg.inv(chebyshev.chebvander(t, nodes - 1)))


@dataclass(frozen=True)
class PathTable:
    """The traced path between the whole panel and the whole pupil at the nodes of both, for one bench.

    `path_m`, `log_amplitude`, `sin_x`, `sin_y` are (panel y, panel x, pupil y, pupil x): path length, log of the square
    root of |det d2L/dx dq| in 1/m, and the direction sines in S of the light that leaves the panel.
    """

    panel: Box
    pupil: Box
    path_m: Array
    log_amplitude: Array
    sin_x: Array
    sin_y: Array

    @classmethod
    @lru_cache(maxsize=4)  # it knows no wavelength: the next line of the laser finds it made
    def trace(cls, bench: Bench, panel: Box, pupil: Box) -> PathTable:
        """Trace the rays between all nodes; the only place where the rig meets the bench."""
        x, q = _grid(panel, PANEL_NODES), _grid(pupil, Q_NODES)
        rays = connect(bench, x[:, None], q[None])
        if not bool(np.all(rays.error_m < 1e-9)):
            raise ConfigError(
                f"With this misalignment a ray from the panel lands {np.nanmax(rays.error_m) * 1e3:.3g} mm off.",
                why="The bench is so far out that the mirror no longer sends the panel's light to the pupil.",
                fix="Reduce the rotations and shifts under [misalignment].",
            )
        cos_sq = 1 / (1 + np.sum(rays.field_tan**2, axis=-1))
        log_amplitude = np.log(cos_sq) - 0.5 * np.log(np.abs(np.linalg.det(rays.mixed)))
        shape = (PANEL_NODES, PANEL_NODES, Q_NODES, Q_NODES)
        sines = rays.slm_direction
        parts = (rays.path_m, log_amplitude, sines[..., 0], sines[..., 1])
        return cls(panel, pupil, *(part.reshape(shape) for part in parts))

    def at(self, values: Array, x: Array, y: Array) -> Array:
        """Interpolate one of the tables to the product grid of panel points: (len(y) * len(x), pupil y * pupil x)."""
        nx, ny = self.panel.normalise(x, y)
        over = np.einsum("iy,jx,yxab->ijab", _interpolation(PANEL_NODES, ny), _interpolation(PANEL_NODES, nx), values)
        return np.asarray(over.reshape(len(x) * len(y), -1))


def fit_patch(table: PathTable, patch: Box, wavelength_m: float) -> PatchKernel:
    """Return the phase between a patch of the panel (S) and the pupil (P) in its separable form."""
    pupil, k = table.pupil, 2 * np.pi / wavelength_m
    nodes_x, nodes_y = patch.nodes(X_NODES)
    x = _grid(patch, X_NODES)
    phase = k * table.at(table.path_m, nodes_x, nodes_y)
    weight_x, weight_q = panel_weight(), pupil_weight(pupil)
    alpha = phase @ weight_q
    beta = weight_x @ (phase - alpha[:, None])
    rest = phase - alpha[:, None] - beta[None]
    left = np.linalg.svd(np.sqrt(weight_x)[:, None] * rest * np.sqrt(weight_q), full_matrices=False)[0][:, :2]
    left = left / np.sqrt(weight_x)[:, None]
    # The decomposition leaves a free 2 x 2 matrix between u and g: fix it so that g is as near to x as it can be.
    g = left @ np.linalg.lstsq(left, x - x.mean(axis=0), rcond=None)[0]
    root = np.sqrt(weight_x)[:, None]
    u = np.linalg.lstsq(root * g, root * rest, rcond=None)[0]
    left_over = rest - g @ u
    residual = float(np.sqrt(weight_x @ left_over**2 @ weight_q))

    def over_patch(values: Array) -> Polynomial:
        return interpolate(patch, values.reshape(X_NODES, X_NODES))

    def over_pupil(values: Array) -> Polynomial:
        return interpolate(pupil, values.reshape(Q_NODES, Q_NODES))

    return PatchKernel(
        alpha=over_patch(alpha),
        gx=over_patch(g[:, 0]),
        gy=over_patch(g[:, 1]),
        beta=over_pupil(beta),
        ux=over_pupil(u[0]),
        uy=over_pupil(u[1]),
        amplitude=np.exp(table.at(table.log_amplitude, nodes_x, nodes_y)),
        fx=table.at(table.sin_x, nodes_x, nodes_y) / wavelength_m,
        fy=table.at(table.sin_y, nodes_x, nodes_y) / wavelength_m,
        rest_rad=left_over,
        residual_rad=residual,
    )


def panel_weight() -> Array:
    """Return the weights of a patch's nodes in a mean over it: Chebyshev nodes crowd at the edges."""
    weight = _uniform(X_NODES)
    return np.asarray(weight / weight.sum())


def pupil_weight(pupil: Box) -> Array:
    """Return the weights of the pupil's nodes in a mean over it: only the disc counts."""
    weight = _uniform(Q_NODES) * np.where(np.hypot(*_grid(pupil, Q_NODES).T) <= 1.02 * pupil.x1, 1.0, 1e-3)
    return np.asarray(weight / weight.sum())


def _uniform(n: int) -> Array:
    """Return weights (n * n,) that make a sum over Chebyshev nodes a mean over the square."""
    t = np.sqrt(1 - np.cos(np.pi * (np.arange(n) + 0.5) / n) ** 2)
    return np.asarray(np.outer(t, t).ravel())
