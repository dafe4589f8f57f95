"""The pupil's fine grid, its transmission, and the directions that its light comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array
from rigs.simulated.kernel import PathTable

Complex = NDArray[np.complex64]

FIELD_MARGIN = 1.06  # of the fine grid's bandwidth against the light that the panel can send


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
    """The fine grid of the pupil: centres `x_m` (columns) and `y_m` (rows, ascending), pitch, and the mean direction.

    `carrier` (sx, sy) is the middle of the direction sines of the light; the field is stored without exp(-i k q.s) of
    it.
    """

    x_m: Array
    y_m: Array
    pitch_m: tuple[float, float]
    carrier: tuple[float, float]

    @classmethod
    def of(cls, table: PathTable, radius_m: float, wavelength_m: float) -> PupilGrid:
        """Return the coarsest grid that holds all light from the panel through a pupil of this radius."""
        slope_x, slope_y = _directions(table)
        pitches, carriers, centres = [], [], []
        for slope in (slope_x, slope_y):
            low, high = float(slope.min()), float(slope.max())
            pitch = float(wavelength_m / ((high - low) * FIELD_MARGIN))
            half = int(np.ceil(radius_m / pitch)) + 1
            pitches.append(pitch)
            carriers.append((low + high) / 2)
            centres.append(np.arange(-half, half + 1, dtype=np.float64) * pitch)
        return cls(centres[0], centres[1], (pitches[0], pitches[1]), (carriers[0], carriers[1]))

    def transmission(self, radius_m: float, edge_m: float) -> NDArray[np.float32]:
        """Return the pupil's amplitude transmission, (columns, rows): 1 inside, a raised cosine over `edge_m`, then 0.

        A knife edge is cut no finer than a cell: cells on the rim by the share of them that lies inside, since a rim
        of whole cells would misplace 1e-4 of the light, 1 % of the speckle's amplitude.
        """
        x, y = self.x_m[:, None].astype(np.float32), self.y_m[None].astype(np.float32)
        r = np.hypot(x, y)
        ramp = (radius_m - r) / np.float32(max(edge_m, max(self.pitch_m)))
        if edge_m < max(self.pitch_m):
            return np.clip(0.5 + ramp, 0.0, 1.0)
        return np.asarray(0.5 + 0.5 * np.sin(np.pi * np.clip(ramp, -0.5, 0.5)), np.float32)


def _directions(table: PathTable) -> tuple[Array, Array]:
    """Return the direction sines in P of the light that reaches the pupil: minus the gradient of the path along q."""
    n = table.path_m.shape[-1]
    t = -np.cos(np.pi * (np.arange(n) + 0.5) / n)
    vander = np.polynomial.chebyshev.chebvander(t, n - 1)
    slopes = np.stack([np.polynomial.chebyshev.chebval(t, np.polynomial.chebyshev.chebder(row)) for row in np.eye(n)])
    derivative = slopes.T @ np.linalg.inv(vander) * 2 / (table.pupil.x1 - table.pupil.x0)
    inside = np.hypot(*np.meshgrid(t, t)) <= 1.02
    along_x = -(table.path_m @ derivative.T)
    along_y = -np.einsum("ij,abjx->abix", derivative, table.path_m)
    return along_x[..., inside], along_y[..., inside]
