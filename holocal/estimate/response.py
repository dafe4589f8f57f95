"""The phase of every level, with its error, from the phases of some: a Gaussian process over the levels.

Between measured levels the curve is taken to be continuous with a continuous slope, or one that may have kinks (Matern
5/2 or 3/2), and single levels may lie off it by some milliradians: what the measured phases speak for is taken, scale
included. What interpolation may be wrong by is in the error of every level.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from holocal.estimate.fringes import UNKNOWN_RAD, Fringes

Array = NDArray[np.float64]

LENGTHS = tuple(float(v) for v in np.geomspace(0.03, 2.0, 9))  # of the whole range of levels
HEIGHTS_RAD = tuple(float(v) for v in np.geomspace(1e-3, 10.0, 13))  # of what is neither constant nor linear
ROUGH_RAD = (0.0, 0.003, 0.006, 0.012, 0.02, 0.035)  # of single levels, off any curve
WIDE_RAD = 30.0  # prior standard deviation of constant and slope: more than any panel's range
JITTER_RAD = 1e-5


@dataclass(frozen=True)
class ResponseTable:
    """The phase of each of a panel's levels.

    `phase_rad` (levels,) begins with 0; `sigma_rad` (levels,) is the standard error once a common piston is taken out,
    which no picture shows; `covariance` (levels, levels) that of the phases against the first.
    """

    phase_rad: Array
    sigma_rad: Array
    covariance: Array
    valid: bool

    @property
    def range_rad(self) -> float:
        """The phase of the last level less that of the first."""
        return float(self.phase_rad[-1] - self.phase_rad[0])

    @property
    def sigma_rms_rad(self) -> float:
        """The error to be expected of the table, rms over its levels."""
        return float(np.sqrt(np.mean(self.sigma_rad**2)))


def nominal_table(count: int) -> Array:
    """Return 2 pi L / count, what a panel of that many levels is taken to do before it is measured."""
    return np.asarray(2 * np.pi * np.arange(count) / count)


def phase_difference(one_rad: ArrayLike, other_rad: ArrayLike) -> Array:
    """Return one - other, round the circle, less its mean over the circle: what a picture could show of it."""
    turned = np.exp(1j * (np.asarray(one_rad, np.float64) - np.asarray(other_rad, np.float64)))
    mean = turned.mean()
    turned = turned * np.conj(mean / abs(mean)) if abs(mean) > 0 else turned
    angle = np.angle(turned)
    return np.asarray(angle - angle.mean() if np.abs(angle).max(initial=0.0) < np.pi / 2 else angle)


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def interpolate_response(found: Fringes, count: int) -> ResponseTable:
    """Return the table of all levels 0 .. count - 1 from measured ones.

    A table of fringes that are not valid is not valid either: 2 pi L / count, with the error of no knowledge.
    """
    if not found.valid:
        unknown = np.full(count, UNKNOWN_RAD)
        return ResponseTable(nominal_table(count), unknown, np.diag(unknown**2), False)
    last = max(count - 1, 1)
    at, everywhere = found.levels / last, np.arange(count) / last
    noise = found.covariance + JITTER_RAD**2 * np.eye(len(at))
    trend, own = _trend(at, at), np.eye(len(at))
    best = (-np.inf, 5, LENGTHS[-1], HEIGHTS_RAD[-1], 0.0)
    distances = np.abs(at[:, None] - at[None])
    for order in (3, 5):
        for length in LENGTHS:
            shape = _matern(distances / length, order)
            for height in HEIGHTS_RAD:
                for rough in ROUGH_RAD:
                    covariance = height**2 * shape + trend + noise + rough**2 * own
                    best = max(best, (_log_evidence(covariance, found.phase_rad), order, length, height, rough))
    _, order, length, height, rough = best

    def kernel(a: Array, b: Array) -> Array:
        distance = np.abs(a[:, None] - b[None])
        return np.asarray(height**2 * _matern(distance / length, order) + _trend(a, b) + rough**2 * (distance == 0))

    across = kernel(everywhere, at)
    gain = np.linalg.solve(kernel(at, at) + noise, across.T).T
    phase = gain @ found.phase_rad
    covariance = kernel(everywhere, everywhere) - gain @ across.T
    covariance = 0.5 * (covariance + covariance.T)
    centred = covariance - covariance.mean(axis=0) - covariance.mean(axis=1)[:, None] + covariance.mean()
    sigma = np.sqrt(np.maximum(np.diag(centred), JITTER_RAD**2))
    return ResponseTable(phase - phase[0], sigma, covariance, True)


def next_levels(table: ResponseTable, used: NDArray[np.int64], how_many: int) -> NDArray[np.int64]:
    """Return the levels worth measuring next: middles of the widest, most curved and least known gaps, ascending.

    A gap's worth is how far its middle lies off the straight line between its ends, and how uncertain it is, both
    times the levels that it holds. Where every level is measured, those with the largest errors come again.
    """
    chosen: list[int] = []
    taken = sorted({int(level) for level in used})
    for _ in range(how_many):
        best, place = -1.0, -1
        for low, high in pairwise(taken):
            if high - low < 2:
                continue
            middle = (low + high) // 2
            share = (middle - low) / (high - low)
            straight = (1 - share) * table.phase_rad[low] + share * table.phase_rad[high]
            off = abs(float(table.phase_rad[middle] - straight)) + float(table.sigma_rad[middle])
            worth = float(np.sqrt(high - low)) * off
            if worth > best:
                best, place = worth, middle
        if place < 0:
            break
        chosen.append(place)
        taken = sorted([*taken, place])
    if len(chosen) < how_many:
        again = [int(level) for level in np.argsort(-table.sigma_rad) if int(level) not in chosen]
        chosen += again[: how_many - len(chosen)]
    return np.array(sorted(chosen), np.int64)


def _matern(scaled: Array, order: int) -> Array:
    """Return the Matern covariance of smoothness `order` / 2 at scaled distances."""
    if order == 3:
        z = np.sqrt(3.0) * scaled
        return np.asarray((1 + z) * np.exp(-z))
    z = np.sqrt(5.0) * scaled
    return np.asarray((1 + z + z * z / 3) * np.exp(-z))


def _trend(a: Array, b: Array) -> Array:
    return np.asarray(WIDE_RAD**2 * (1 + a[:, None] * b[None]))


def _log_evidence(covariance: Array, values: Array) -> float:
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return -np.inf
    white = np.linalg.solve(factor, values)
    return float(-0.5 * white @ white - np.log(np.diag(factor)).sum())
