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
ROUNDS, SETTLED = 12, 1e-3  # Gauss-Newton steps; the last one, in standard errors
TAIL = 4.0  # degrees of freedom of the residuals' Student distribution
LARGEST_STEP = 1.0  # of the prior's standard deviations

Predict = Callable[[Array], Array]


def bench_at(nominal: Bench, values: Array) -> Bench:
    """Return the bench with displacements (12,) in the order of `DISPLACEMENTS`, degrees and mm."""
    mirror, slm = np.asarray(values, np.float64).reshape(2, 6)
    return replace(nominal, mirror=_pose(mirror), slm=_pose(slm))


def _pose(values: Array) -> Pose:
    turn, shift = values[:3] * DEGREE, values[3:] * MM
    return Pose((turn[0], turn[1], turn[2]), (shift[0], shift[1], shift[2]))


@dataclass(frozen=True)
class PoseFit:
    """A fitted pose: `values` (12,) degrees and mm; `covariance` (12, 12) with the prior; `information` (12, 12) of the
    data alone; `residual` (m,) in standard errors, measured less predicted; `jacobian` (m, 12) of the prediction;
    `used` (m,); `scale`: how many times larger the residuals are than their standard errors say."""

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
    for _ in range(ROUNDS):
        at, jacobian = _linearised(predict, values, STEP * prior_sigma)
        off = (measured - at) / sigma
        used = np.isfinite(off) & np.all(np.isfinite(jacobian), axis=1)
        off, slope = off[used], jacobian[used] / sigma[used, None]
        scale = _scale(off)
        weight = (TAIL + 1) / (TAIL + (off / scale) ** 2) / scale**2
        information = slope.T @ (weight[:, None] * slope)
        normal = information + precision
        step = np.linalg.solve(normal, slope.T @ (weight * off) - precision @ values)
        covariance = np.linalg.inv(normal)
        largest = float(np.max(np.abs(step / prior_sigma)))
        values = values + step * min(1.0, LARGEST_STEP / max(largest, 1e-30))
        if np.max(np.abs(step) / np.sqrt(np.diag(covariance))) < SETTLED:
            break
    left = np.full(len(measured), np.nan)
    left[used] = off - slope @ step
    return PoseFit(values, covariance, information, left, jacobian, used, scale)


def _linearised(predict: Predict, values: Array, steps: Array) -> tuple[Array, Array]:
    at = predict(values)
    columns = [(predict(values + own) - at) / np.max(own) for own in np.diag(steps)]
    return at, np.stack(columns, axis=1)


def _scale(off: Array) -> float:
    """Return the residuals' robust size, at least 1."""
    return max(1.0, 1.4826 * float(np.median(np.abs(off)))) if len(off) else 1.0
