"""The pupil's grid, its transmission, and the mean wave that its light rides on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array
from rigs.simulated.kernel import PathTable

Complex = NDArray[np.complex64]

FIELD_MARGIN = 1.03  # of the grid's bandwidth against the light that the panel can send
# What the pupil's rim diffracts lies within 3 wavelengths over its width (a raised cosine: 1e-3 of amplitude beyond).
EDGE_ORDERS = 3.0
FINEST_EDGE_M = 2e-5  # a knife edge diffracts without end: beyond this its light is a thousandth


def unit_phase(phase_rad: Array) -> Complex:
    """Return exp(i phase) as complex64 from a float64 phase, reduced before it is rounded."""
    turns = phase_rad * (1 / (2 * np.pi))
    turns -= np.rint(turns)
    reduced = (turns * (2 * np.pi)).astype(np.float32)
    out = np.empty(phase_rad.shape, np.complex64)
    np.cos(reduced, out=out.real)
    np.sin(reduced, out=out.imag)
    return out


@dataclass(frozen=True)
class PupilGrid:
    """The pupil's grid: centres `x_m` (columns) and `y_m` (rows, ascending), pitch, and the light's mean path.

    The light through the pupil converges on the panel's image, 12 mm behind it: from the place q it comes along the
    direction sines s(q) = `carrier` + `curvature` q, spread by the panel's own size. The field is stored without that
    mean wave, exp(-i k (carrier . q + q . curvature q / 2)), so the grid holds only the spread: at 4K a fourth of the
    samples that the whole field would take, for a small panel a fiftieth.
    """

    x_m: Array
    y_m: Array
    pitch_m: tuple[float, float]
    carrier: tuple[float, float]
    curvature_per_m: tuple[float, float, float]  # xx, xy, yy

    @classmethod
    def of(cls, table: PathTable, radius_m: float, wavelength_m: float, edge_m: float) -> PupilGrid:
        """Return the coarsest grid that holds all light from the panel through a pupil of this radius and edge."""
        slopes = _directions(table)
        q = _nodes_inside(table)
        curvature = _curvature(slopes, q)
        xx, xy, yy = curvature
        mean = (xx * q[:, 0] + xy * q[:, 1], xy * q[:, 0] + yy * q[:, 1])
        diffraction = 2 * EDGE_ORDERS * wavelength_m / max(edge_m, FINEST_EDGE_M)
        pitches, carriers, centres = [], [], []
        for slope, middle in zip(slopes, mean, strict=True):
            low, high = float((slope - middle).min()), float((slope - middle).max())
            pitch = float(wavelength_m / ((high - low) * FIELD_MARGIN + diffraction))
            half = int(np.ceil(radius_m / pitch)) + 1
            pitches.append(pitch)
            carriers.append((low + high) / 2)
            centres.append(np.arange(-half, half + 1, dtype=np.float64) * pitch)
        return cls(centres[0], centres[1], (pitches[0], pitches[1]), (carriers[0], carriers[1]), curvature)

    def mean_path_m(self, x: Array, y: Array) -> Array:
        """Return minus the path of the mean wave at points of the pupil: the stored field is U exp(i k of it)."""
        xx, xy, yy = self.curvature_per_m
        return np.asarray(self.carrier[0] * x + self.carrier[1] * y + (xx * x * x + 2 * xy * x * y + yy * y * y) / 2)

    def transmission(self, radius_m: float, edge_m: float) -> NDArray[np.float32]:
        """Return the pupil's amplitude transmission, (rows, columns): 1 inside, a raised cosine over `edge_m`, then 0.

        A knife edge is cut no finer than a cell: cells on the rim by the share of them that lies inside, since a rim
        of whole cells would misplace 1e-4 of the light, 1 % of the speckle's amplitude.
        """
        x, y = self.x_m[None].astype(np.float32), self.y_m[:, None].astype(np.float32)
        r = np.hypot(x, y)
        ramp = (radius_m - r) / np.float32(max(edge_m, max(self.pitch_m)))
        if edge_m < max(self.pitch_m):
            return np.clip(0.5 + ramp, 0.0, 1.0)
        return np.asarray(0.5 + 0.5 * np.sin(np.pi * np.clip(ramp, -0.5, 0.5)), np.float32)


def _nodes_inside(table: PathTable) -> Array:
    """Return the pupil points of the table that lie in the pupil, (n, 2) metres."""
    n = table.path_m.shape[-1]
    x, y = np.meshgrid(*table.pupil.nodes(n))
    inside = np.hypot(x, y) <= 1.02 * table.pupil.x1
    return np.stack([x[inside], y[inside]], axis=1)


def _curvature(slopes: tuple[Array, Array], q: Array) -> tuple[float, float, float]:
    """Return the symmetric matrix (xx, xy, yy) of ds / dq, least squares over the pupil of the panel's mean."""
    mean = [slope.reshape(-1, len(q)).mean(axis=0) for slope in slopes]
    zero = np.zeros(len(q))
    along_x = np.stack([q[:, 0], q[:, 1], zero, np.ones(len(q)), zero], axis=1)
    along_y = np.stack([zero, q[:, 0], q[:, 1], zero, np.ones(len(q))], axis=1)
    found = np.linalg.lstsq(np.concatenate([along_x, along_y]), np.concatenate(mean), rcond=None)[0]
    return float(found[0]), float(found[1]), float(found[2])


def _directions(table: PathTable) -> tuple[Array, Array]:
    """Return the direction sines in P of the light that reaches the pupil: minus the gradient of the path along q.

    Each is (panel y, panel x, points of `_nodes_inside`).
    """
    n = table.path_m.shape[-1]
    t = -np.cos(np.pi * (np.arange(n) + 0.5) / n)
    vander = np.polynomial.chebyshev.chebvander(t, n - 1)
    slopes = np.stack([np.polynomial.chebyshev.chebval(t, np.polynomial.chebyshev.chebder(row)) for row in np.eye(n)])
    derivative = slopes.T @ np.linalg.inv(vander) * 2 / (table.pupil.x1 - table.pupil.x0)
    inside = np.hypot(*np.meshgrid(t, t)) <= 1.02
    along_x = -(table.path_m @ derivative.T)
    along_y = -np.einsum("ij,abjx->abix", derivative, table.path_m)
    return along_x[..., inside], along_y[..., inside]
