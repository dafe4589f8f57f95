"""A smooth map of the plane from measured pairs: evaluated anywhere, with its Jacobian, its error and its inverse.

A homography holds the perspective, Chebyshev polynomials what lenses do, a penalised spline what is left. How much of
each is decided by points that the fit has not seen (`map_fit`). Beyond the convex hull of the data the map goes on
straight, with the value and the slope of the nearest point of the hull: a polynomial of degree 7 would not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from holocal.estimate.map_basis import Box, SplineBasis, apply_homography, chebyshev, chebyshev_slopes

Array = NDArray[np.float64]

AT_ONCE = 1 << 15  # points: 55 terms of them are 14 MB
INVERSE_PX = 1e-4  # the residual at which an inversion ends
INVERTED_PX = 1e-2  # the residual that counts as found
NEWTON_STEPS = 40
BEND_STEP = 0.05  # of the box's half side, over which the slope's change is taken
LONGEST_STEP = 0.25  # of the box's half side


@dataclass(frozen=True)
class Spline:
    """What polynomials leave: `coefficients` (terms, 2), `covariance` (terms, terms) in units of the noise squared."""

    basis: SplineBasis
    coefficients: Array
    covariance: Array


@dataclass(frozen=True)
class SmoothMap:
    """A map (u, v) -> (x, y); x and y are called pixels here.

    Parameters
    ----------
    points, places
        The data, (n, 2) each.
    box
        What is scaled to [-1, 1].
    homography
        (3, 3).
    degree
        Total degree of the polynomials.
    coefficients
        (terms, 2), pixels, of the Chebyshev products in the order of `map_basis.degrees`.
    covariance
        (terms, terms) of each column of them, in units of the noise squared.
    spline
        What they leave, or None.
    noise_px
        Standard deviation of one coordinate of a measured place.
    weight
        (n,) of the points in the fit: by their variances, and 0 for outliers.
    holdout_px
        (n, 2), place less the map that was fitted without it (and without a fifth of the others).
    """

    points: Array
    places: Array
    box: Box
    homography: Array
    degree: int
    coefficients: Array
    covariance: Array
    spline: Spline | None
    noise_px: float
    weight: Array
    holdout_px: Array

    @property
    def holdout_rms_px(self) -> float:
        """Weighted root mean square, outliers left out, of the two-dimensional distance `holdout_px`."""
        return float(np.sqrt(np.average((self.holdout_px**2).sum(axis=1), weights=self.weight)))

    @property
    def outlier(self) -> NDArray[np.bool_]:
        """Which points (n,) are so far off the map of the others that they had no say in it."""
        return np.asarray(self.weight == 0)

    def __call__(self, points: Array) -> Array:
        """Return the places (n, 2) of points (n, 2)."""
        return self.with_jacobian(points)[0]

    def jacobian(self, points: Array) -> Array:
        """Return the derivatives (n, 2, 2) at points (n, 2), [i, j] = d place_i / d point_j; constant off the hull."""
        return self.with_jacobian(points)[1]

    def with_jacobian(self, points: Array) -> tuple[Array, Array]:
        """Return places (n, 2) and Jacobian (n, 2, 2) of points (n, 2)."""
        points = np.asarray(points, np.float64).reshape(-1, 2)
        places, jacobian = np.empty((len(points), 2)), np.empty((len(points), 2, 2))
        for start in range(0, len(points), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            near = self.nearest(points[part])
            at, slope = self._on_hull(near)
            places[part] = at + np.einsum("nij,nj->ni", slope, points[part] - near)
            jacobian[part] = slope
        return places, jacobian

    def sigma_px(self, points: Array) -> Array:
        """Return the standard deviation (n,) of each coordinate of the map at points (n, 2).

        Beyond the hull it grows with the uncertainty of the slope there, and with the square of the distance as much
        as the map bends just within or, if that is more, on the whole.
        """
        points = np.asarray(points, np.float64).reshape(-1, 2)
        variance = np.empty(len(points))
        for start in range(0, len(points), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            near = self.nearest(points[part])
            beyond = (points[part] - near) / self.box.half
            scaled = self.box.scaled(near)
            along = chebyshev(scaled, self.degree)
            along += np.einsum("ntj,nj->nt", chebyshev_slopes(scaled, self.degree), beyond)
            mean = np.einsum("nt,tk,nk->n", along, self.covariance, along, optimize=True)
            if self.spline is not None:
                basis = self.spline.basis.values(scaled)
                mean += np.asarray(basis.multiply(basis @ self.spline.covariance).sum(axis=1)).ravel()
            bend = np.zeros(len(near))
            outside = np.flatnonzero((beyond != 0).any(axis=1))
            bend[outside] = self._bend_px(near[outside], beyond[outside])
            variance[part] = np.maximum(mean, 0) * self.noise_px**2 + bend**2
        return np.sqrt(variance)

    def inverse(self, places: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the points (n, 2) that go to places (n, 2), and whether each was found to 0.01 px (n,)."""
        places = np.asarray(places, np.float64).reshape(-1, 2)
        _, nearest = cKDTree(self.places).query(places)
        points = self.points[nearest].copy()
        residual = np.full(len(places), np.inf)
        open_ = np.arange(len(places))
        damping = np.ones(len(places))
        best = points.copy()
        for _ in range(NEWTON_STEPS):
            seen, slope = self.with_jacobian(points[open_])
            left = places[open_] - seen
            distance = np.linalg.norm(left, axis=1)
            better = distance < residual[open_]
            damping[open_] = np.where(better, np.minimum(2 * damping[open_], 1), damping[open_] / 2)
            best[open_[better]], residual[open_[better]] = points[open_[better]], distance[better]
            determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
            sane = np.abs(determinant) > 1e-300
            slope[~sane] = np.eye(2)
            step = np.linalg.solve(slope, left[..., None])[..., 0] * damping[open_, None]
            longest = np.abs(step / self.box.half).max(axis=1)
            step *= np.minimum(1, LONGEST_STEP / np.maximum(longest, 1e-300))[:, None]
            points[open_] = np.where(better[:, None], points[open_], best[open_]) + step
            open_ = open_[(residual[open_] > INVERSE_PX) & sane]
            if not len(open_):
                break
        return best, residual <= INVERTED_PX

    def nearest(self, points: Array) -> Array:
        """Return the nearest points (n, 2) of the data's convex hull: themselves, for points within."""
        corner, normal, offset = self._hull
        unit = float(self.box.half.max())
        at = (points - self.box.middle) / unit
        outside = np.flatnonzero((at @ normal.T + offset > 1e-12).any(axis=1))
        if not len(outside):
            return points
        edge = np.roll(corner, -1, axis=0) - corner
        length2 = np.maximum((edge**2).sum(axis=1), 1e-300)
        along = np.clip(((at[outside, None] - corner) * edge).sum(axis=2) / length2, 0, 1)
        feet = corner + along[..., None] * edge
        chosen = np.argmin(((at[outside, None] - feet) ** 2).sum(axis=2), axis=1)
        found = np.array(points, np.float64)
        found[outside] = feet[np.arange(len(outside)), chosen] * unit + self.box.middle
        return found

    def _on_hull(self, points: Array) -> tuple[Array, Array]:
        places, jacobian = apply_homography(self.homography, points)
        scaled = self.box.scaled(points)
        places = places + chebyshev(scaled, self.degree) @ self.coefficients
        slopes = np.einsum("ntj,ti->nij", chebyshev_slopes(scaled, self.degree), self.coefficients, optimize=True)
        if self.spline is not None:
            places += self.spline.basis.values(scaled) @ self.spline.coefficients
            along = [basis @ self.spline.coefficients for basis in self.spline.basis.slopes(scaled)]
            slopes += np.stack(along, axis=-1)
        return places, jacobian + slopes / self.box.half

    @cached_property
    def _hull(self) -> tuple[Array, Array, Array]:
        """Corners (k, 2) in order, outward normals and offsets of the hull, in units of the longer half side."""
        at = (self.points - self.box.middle) / float(self.box.half.max())
        try:
            hull = ConvexHull(at)
        except QhullError:  # all on a line
            low, high = at.min(axis=0), at.max(axis=0)
            corner = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
            normal = np.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]])
            return corner, normal, np.array([low[0], -high[0], low[1], -high[1]])
        return at[hull.vertices], hull.equations[:, :2], hull.equations[:, 2]

    def _bend_px(self, near: Array, beyond: Array) -> Array:
        """Return what going on straight from points of the hull (n, 2) by steps (n, 2), in half sides, leaves out."""
        length = np.linalg.norm(beyond, axis=1)
        along = beyond / np.maximum(length, 1e-300)[:, None] * self.box.half
        bends = []
        for start in (near, self._some_within):
            step = BEND_STEP * (along if start is near else self.box.half / np.sqrt(2) * np.ones_like(start))
            change = self._on_hull(start)[1] - self._on_hull(start - step)[1]
            bends.append(np.linalg.norm(np.einsum("nij,nj->ni", change, step), axis=1) / BEND_STEP**2)
        whole = float(np.sqrt(np.mean(bends[1] ** 2)))
        return np.asarray(np.maximum(bends[0], whole) * length**2 / 2)

    @cached_property
    def _some_within(self) -> Array:
        """Some of the points, (m, 2)."""
        return self.points[:: max(1, len(self.points) // 300)]
