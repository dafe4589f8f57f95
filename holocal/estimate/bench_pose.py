"""The pose of mirror and panel that explains what was measured: Gauss-Newton through the ray trace, Laplace errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array, Bench, Pose
from holocal.units import DEGREE, MM

PARTS = ("mirror", "slm")
DISPLACEMENTS = tuple(
    f"{part}_{kind}{axis}_{unit}"
    for part in PARTS
    for kind, unit in (("r", "deg"), ("d", "mm"))
    for axis in "xyz"
)  # fmt: skip
STEP = 3e-3  # of the prior's standard deviations, of the derivatives
LINEAR = 0.05  # of the prior's standard deviations: over so much the middles are nearly linear
ROUNDS, SETTLED = 16, 0.03  # Gauss-Newton steps; the last one, in standard errors
POLISHED = 3  # at most, of them with differences along the posterior's own axes
TAIL = 4.0  # degrees of freedom of the residuals' Student distribution
LEAST_SCALE = 0.6  # of residuals, over their errors: what a model lacks is alike from spot to spot, and partly unseen
LARGEST_STEP = 1.0  # of the prior's standard deviations

Predict = Callable[[Array], Array]


def bench_at(nominal: Bench, values: Array) -> Bench:
    """Return the bench with displacements (12,) in the order of `DISPLACEMENTS`, degrees and mm."""
    mirror, slm = np.asarray(values, np.float64).reshape(2, 6)
    return replace(nominal, mirror=_pose(mirror), slm=_pose(slm))


def _pose(values: Array) -> Pose:
    turn, shift = values[:3] * DEGREE, values[3:] * MM
    return Pose((turn[0], turn[1], turn[2]), (shift[0], shift[1], shift[2]))


def spun(nominal: Bench, values: Array, angles_rad: Array) -> Array:
    """Return the displacements (n, 12) of the same bench with its mirror turned about its own axis by angles (n,).

    The mirror is a surface of revolution: what such a turn changes no picture can tell.
    """
    mirror = _pose(np.asarray(values, np.float64)[:6])
    axis = nominal.nominal_slm_centre / np.linalg.norm(nominal.nominal_slm_centre)
    arm = nominal.nominal_slm_centre / 2 - nominal.mirror_point
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    out = np.tile(np.asarray(values, np.float64), (len(angles_rad), 1))
    for row, angle in zip(out, angles_rad, strict=True):
        turned = mirror.matrix @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
        about_x, about_z = np.arctan2(turned[2, 1], turned[2, 2]), np.arctan2(turned[1, 0], turned[0, 0])
        row[:3] = np.array([about_x, -np.arcsin(turned[2, 0]), about_z]) / DEGREE
        row[3:6] = (np.asarray(mirror.shift_m) + (mirror.matrix - turned) @ arm) / MM
    return out


@dataclass(frozen=True)
class PoseFit:
    """A fitted pose: `values` (12,) degrees and mm; `covariance` (12, 12) with the prior; `information` (12, 12) of the
    data alone; `residual` (m,) in standard errors, measured less predicted; `jacobian` (m, 12) of the prediction;
    `used` (m,); `scale`: how many times larger the residuals are than their standard errors say, by which the errors
    are widened."""

    values: Array
    covariance: Array
    information: Array
    residual: Array
    jacobian: Array
    used: NDArray[np.bool_]
    scale: float


def fit_pose(predict: Predict, measured: Array, sigma: Array, prior_sigma: Array) -> PoseFit:
    """Return the most probable parameters.

    Parameters
    ----------
    predict
        What parameters (p,) would give, (m,); NaN where they give nothing.
    measured, sigma
        (m,) measurements and their standard errors; what is not finite does not count.
    prior_sigma
        (p,) standard deviation of every parameter before the measurement, about 0.
    """
    values = np.zeros(len(prior_sigma))
    precision = np.diag(prior_sigma**-2.0)
    across = np.diag(STEP * prior_sigma)
    polished = 0
    for _ in range(ROUNDS):
        at, jacobian = _linearised(predict, values, across, central=polished > 0)
        off = (measured - at) / sigma
        used = np.isfinite(off) & np.all(np.isfinite(jacobian), axis=1)
        off, slope = off[used], jacobian[used] / sigma[used, None]
        scale = residual_scale(off)
        weight = (TAIL + 1) / (TAIL + (off / scale) ** 2) / scale**2
        normal = slope.T @ (weight[:, None] * slope) + precision
        step = np.linalg.solve(normal, slope.T @ (weight * off) - precision @ values)
        covariance = np.linalg.inv(normal)
        largest = float(np.max(np.abs(step / prior_sigma)))
        values = values + step * min(1.0, LARGEST_STEP / max(largest, 1e-30))
        settled = float(np.sqrt(step @ normal @ step)) < SETTLED
        if polished == POLISHED or (polished and settled):
            break
        if settled or polished:
            polished += 1
            across = _axes(covariance, prior_sigma)
    left = np.full(len(measured), np.nan)
    left[used] = remaining = off - slope @ step
    # The tail's own curvature: less than the weights' where residuals are large.
    square = (remaining / scale) ** 2
    curved = np.maximum((TAIL + 1) * (TAIL - square) / (TAIL + square) ** 2, 0.0) / scale**2
    information = slope.T @ (curved[:, None] * slope)
    covariance = np.linalg.inv(information + precision)
    return PoseFit(values, covariance, information, left, jacobian, used, scale)


def _linearised(predict: Predict, values: Array, across: Array, *, central: bool) -> tuple[Array, Array]:
    """Return the prediction and its derivatives, by differences along the columns of `across` (p, p)."""
    at = predict(values)
    ahead = np.stack([predict(values + own) for own in across.T], axis=1)
    if central:
        behind = np.stack([predict(values - own) for own in across.T], axis=1)
        return at, (ahead - behind) / 2 @ np.linalg.inv(across)
    return at, (ahead - at[:, None]) @ np.linalg.inv(across)


def _axes(covariance: Array, prior_sigma: Array) -> Array:
    """Return the posterior's axes, columns a standard deviation long or as far as the middles are nearly linear.

    Well and badly known combinations differ by 10^4: differences along the single displacements would mix the bend of
    the first into the slope of the others.
    """
    strength, vectors = np.linalg.eigh(covariance / np.outer(prior_sigma, prior_sigma))
    return np.asarray(prior_sigma[:, None] * vectors * np.minimum(np.sqrt(np.maximum(strength, 1e-18)), LINEAR))


def residual_scale(off: Array) -> float:
    """Return the residuals' robust size, at least `LEAST_SCALE`."""
    return max(LEAST_SCALE, 1.4826 * float(np.median(np.abs(off)))) if len(off) else 1.0
