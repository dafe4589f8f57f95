"""Fits a smooth map: as many polynomials, and as smooth a spline, as predict best what the fit has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from holocal.errors import UsageError
from holocal.estimate.map_basis import Box, SplineBasis, apply_homography, chebyshev, degrees, fit_homography
from holocal.estimate.smooth_map import SmoothMap, Spline

Array = NDArray[np.float64]

HIGHEST_DEGREE = 9
FOLDS = 5
LEAST_POINTS = 6
POINTS_PER_TERM = 1.5
AS_GOOD = 1.01  # of the least held-out error: the lowest degree that reaches it is taken
STRUCTURED = 1.02  # times the local noise: above, the polynomials have left something
WORTHWHILE = 0.98  # of the polynomials' held-out error, which a spline must reach
CELLS_PER_KNOT = 5.0  # points along an axis for each interval of the spline
MOST_INTERVALS = 24
SMOOTHNESS = (1.0, 1e-4, 1e5)  # where the search of it starts and ends
FAR = 4.0  # noise deviations beyond which a point counts less while outliers are looked for
OUTLIER = 5.0  # noise deviations: of Gaussian errors in two dimensions 4 in a million
MEDIAN_OF_RAYLEIGH = 1.1774
LOCAL = 24  # neighbours of the local quadratic


def fit_smooth_map(
    points: Array, places: Array, *, sigma_px: Array | None = None, highest_degree: int = HIGHEST_DEGREE, seed: int = 0
) -> SmoothMap:
    """Return the map from points to places.

    Parameters
    ----------
    points
        (n, 2), (u, v), n >= 6 and not all on a line; a lattice's (column, row), for instance.
    places
        (n, 2), (x, y) in pixels.
    sigma_px
        (n,) of each coordinate of the places; equal for all by default. Only their ratios matter: the noise itself is
        estimated.
    highest_degree
        The total degree is chosen among 1 and this.
    seed
        Of the division in folds.

    Raises
    ------
    UsageError
        There are too few points.
    """
    points, places = np.asarray(points, np.float64), np.asarray(places, np.float64)
    if len(points) < LEAST_POINTS:
        raise UsageError(f"a map through {len(points)} points.", fix=f"Give at least {LEAST_POINTS}.")
    prior = _weights(sigma_px, len(points))
    box = Box.around(points)
    fold = np.random.default_rng(seed).permutation(len(points)) % min(FOLDS, len(points))
    homography = _perspective(points, places, prior)
    left = places - apply_homography(homography, points)[0]
    scaled = box.scaled(points)
    basis = chebyshev(scaled, _most(len(points), highest_degree))
    weight = prior
    for last in (False, False, True):
        degree, held = _best_degree(basis, left, _Grams.of(basis, left, weight, fold), fold)
        size = np.sqrt(prior * (held**2).sum(axis=1))
        size /= max(float(np.median(size)) / MEDIAN_OF_RAYLEIGH, 1e-12)
        # Less and less while the fit finds itself, as in the tail of a Student's distribution; then an outlier is out.
        weight = prior * (size <= OUTLIER) if last else prior / (1 + (size / FAR) ** 2) ** 2
    grams = _Grams.of(basis, left, weight, fold)
    degree, held = _best_degree(basis, left, grams, fold)
    basis = basis[:, : _terms(degree)]
    coefficients, covariance, noise = _final(basis, left, weight, degree)
    spline = None
    if _robust_rms(np.linalg.norm(held, axis=1)) > STRUCTURED * _robust_rms(local_residual_px(points, places)):
        spline, held = _with_spline(scaled, basis, left, weight, fold, held, box, coefficients)
        if spline is not None:
            rest = left - basis @ coefficients - spline.basis.values(scaled) @ spline.coefficients
            noise = float(np.sqrt(np.average((rest**2).mean(axis=1), weights=weight)))
    return SmoothMap(points, places, box, homography, degree, coefficients, covariance, spline, noise, weight, held)


def local_residual_px(points: Array, places: Array) -> Array:
    """Return how far (n,) each place lies from a quadratic through its neighbours: what no smooth map takes away.

    The quadratic goes through a point and its 24 nearest neighbours, (n, 2) with their places (n, 2); the distance is
    in two dimensions, made up for the degrees of freedom that the quadratic has taken. At the rim, where the neighbours
    lie on one side, it shows a strong lens too. With fewer than 12 points it is 0: nobody knows.
    """
    count = min(LOCAL + 1, len(points))
    if count < 12:
        return np.zeros(len(points))
    _, index = cKDTree(points).query(points, k=count)
    offset = points[index] - points[:, None]
    offset = offset / np.maximum(np.abs(offset).max(axis=(1, 2), keepdims=True), 1e-300)
    u, v = offset[..., 0], offset[..., 1]
    features = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    normal = features.transpose(0, 2, 1) @ features + 1e-9 * np.eye(6)
    inverse = np.linalg.inv(normal)
    solved = inverse @ (features.transpose(0, 2, 1) @ (places[index] - places[:, None]))
    freedom = np.maximum(1 - inverse[:, 0, 0], 0.05)
    return np.asarray(np.sqrt((solved[:, 0] ** 2).sum(axis=1) / freedom))


def _weights(sigma_px: Array | None, count: int) -> Array:
    if sigma_px is None:
        return np.ones(count)
    # No place is so sure that it decides alone: the map and the target add as much as the surest tenth has.
    surest = max(float(np.quantile(sigma_px, 0.1)), 1e-12)
    weight = 1 / (1 + (np.asarray(sigma_px, np.float64) / surest) ** 2)
    return np.asarray(weight / weight.mean())


def _perspective(points: Array, places: Array, weight: Array) -> Array:
    """Return the homography, or an affine map where points are few or the homography has its horizon amid them."""
    if len(points) >= 2 * LEAST_POINTS:
        found = fit_homography(points, places, weight)
        depth = np.column_stack([points, np.ones(len(points))]) @ found[2]
        if np.isfinite(found).all() and depth.min() > 0.05 * depth.max() > 0:
            return found
    box = Box.around(points)
    lifted = np.column_stack([box.scaled(points), np.ones(len(points))]) * np.sqrt(weight)[:, None]
    solved = np.linalg.lstsq(lifted, places * np.sqrt(weight)[:, None], rcond=None)[0].T
    linear = solved[:, :2] / box.half
    return np.vstack([np.column_stack([linear, solved[:, 2] - linear @ box.middle]), [0, 0, 1]])


def _terms(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2


def _most(count: int, highest: int) -> int:
    """Return the highest degree that so many points can decide about."""
    return max([1, *[d for d in range(1, highest + 1) if POINTS_PER_TERM * _terms(d) <= 0.8 * count]])


@dataclass(frozen=True)
class _Grams:
    """Normal equations of each fold: `normal` (folds, terms, terms), `right` (folds, terms, 2)."""

    normal: Array
    right: Array

    @classmethod
    def of(cls, basis: Array, left: Array, weight: Array, fold: NDArray[np.int64]) -> _Grams:
        rows = [fold == k for k in range(int(fold.max()) + 1)]
        weighted = [basis[row].T * weight[row] for row in rows]
        return cls(
            np.stack([w @ basis[row] for w, row in zip(weighted, rows, strict=True)]),
            np.stack([w @ left[row] for w, row in zip(weighted, rows, strict=True)]),
        )

    def without(self, k: int, terms: int) -> tuple[Array, Array]:
        normal, right = self.normal.sum(axis=0) - self.normal[k], self.right.sum(axis=0) - self.right[k]
        return normal[:terms, :terms], right[:terms]


def _best_degree(basis: Array, left: Array, grams: _Grams, fold: NDArray[np.int64]) -> tuple[int, Array]:
    """Return the lowest degree that predicts as well as any, and what it leaves of each place unseen (n, 2)."""
    degree = 1
    tried: list[tuple[int, Array]] = []
    while _terms(degree) <= basis.shape[1]:
        terms = _terms(degree)
        held = np.empty_like(left)
        for k in range(len(grams.normal)):
            out = fold == k
            held[out] = left[out] - basis[out, :terms] @ _solved(*grams.without(k, terms))
        tried.append((degree, held))
        degree += 1
    least = min(_robust_rms(np.linalg.norm(held, axis=1)) for _, held in tried)
    return next((d, held) for d, held in tried if _robust_rms(np.linalg.norm(held, axis=1)) <= AS_GOOD * least)


def _final(basis: Array, left: Array, weight: Array, degree: int) -> tuple[Array, Array, float]:
    """Return coefficients, their covariance in units of the noise squared, and the noise in pixels.

    The coefficients of each degree are expected to be as large as those of that degree are: the data decide wherever
    they are, and where they are not (a dark quadrant) the polynomials do not run away.
    """
    normal, right = (basis.T * weight) @ basis, (basis.T * weight) @ left
    coefficients = _solved(normal, right)
    freedom = max(1.0, np.count_nonzero(weight) - basis.shape[1]) * float(weight[weight > 0].mean())
    noise2 = float((weight[:, None] * (left - basis @ coefficients) ** 2).sum()) / (2 * freedom)
    of_degree = degrees(degree).sum(axis=1)
    size = np.array([np.mean(coefficients[of_degree == n] ** 2) for n in range(degree + 1)])
    expected = 4 * np.maximum(size, noise2 / len(left))[of_degree]
    ridge = np.where(of_degree > 1, noise2 / np.maximum(expected, 1e-300), 0)
    normal = normal + np.diag(ridge)
    return _solved(normal, right), np.linalg.pinv(normal, hermitian=True), float(np.sqrt(noise2))


def _with_spline(
    scaled: Array,
    basis: Array,
    left: Array,
    weight: Array,
    fold: NDArray[np.int64],
    held: Array,
    box: Box,
    coefficients: Array,
) -> tuple[Spline | None, Array]:
    """Return the spline that predicts best what the polynomials leave, and what is then left of each place unseen."""
    per_side = np.sqrt(len(scaled) * box.half / box.half[::-1]) / CELLS_PER_KNOT
    intervals = np.clip(np.rint(per_side), 1, MOST_INTERVALS).astype(int)
    splines = SplineBasis((int(intervals[0]), int(intervals[1])))
    values = splines.values(scaled)
    grams = _Grams.of(basis, left, weight, fold)
    normals, rights = [], []
    unseen = []
    for k in range(len(grams.normal)):
        seen = fold != k
        rest = left - basis @ _solved(*grams.without(k, basis.shape[1]))
        weighted = values[seen].multiply(weight[seen, None]).tocsr()
        normals.append((weighted.T @ values[seen]).toarray())
        rights.append(weighted.T @ rest[seen])
        unseen.append((~seen, values[~seen], rest[~seen]))

    def trial(smoothness: float) -> Array:
        out = np.empty_like(left)
        for normal, right, (rows, there, rest) in zip(normals, rights, unseen, strict=True):
            out[rows] = rest - there @ _solved(normal + smoothness * splines.roughness, right)
        return out

    smoothness, trials = _smoothest(trial)
    if _robust_rms(np.linalg.norm(trials, axis=1)) > WORTHWHILE * _robust_rms(np.linalg.norm(held, axis=1)):
        return None, held
    weighted = values.multiply(weight[:, None]).tocsr()
    normal = (weighted.T @ values).toarray() + smoothness * splines.roughness
    solved = _solved(normal, weighted.T @ (left - basis @ coefficients))
    return Spline(splines, solved, np.linalg.pinv(normal, hermitian=True)), trials


def _smoothest(trial: Callable[[float], Array]) -> tuple[float, Array]:
    """Return the smoothness that predicts best, and what it leaves (n, 2); the error has one valley."""
    best, held = SMOOTHNESS[0], trial(SMOOTHNESS[0])
    least = _robust_rms(np.linalg.norm(held, axis=1))
    for factor in (10.0, 0.1):
        moved = False
        while SMOOTHNESS[1] <= best * factor <= SMOOTHNESS[2]:
            candidate = trial(best * factor)
            error = _robust_rms(np.linalg.norm(candidate, axis=1))
            if error >= least:
                break
            best, held, least, moved = best * factor, candidate, error, True
        if moved:
            break
    return best, held


def _solved(normal: Array, right: Array) -> Array:
    """Return the solution of positive semidefinite equations, with a breath of a ridge where they are singular."""
    ridge = 1e-12 * float(np.trace(normal)) / len(normal)
    return np.asarray(cho_solve(cho_factor(normal + ridge * np.eye(len(normal))), right))


def _robust_rms(distance: Array) -> float:
    """Return the rms distance with the farthest held to `FAR` times the median: one bad dot chooses no degree."""
    return float(np.sqrt(np.mean(np.minimum(distance, FAR * np.median(distance)) ** 2)))
