"""What the camera's lens makes of the field in the pupil: the power on every pixel.

A speckle grain is 0.3 pixel (docs/physics.md 6), so the field is computed at 5 x 5 points in every pixel (fewer where
the panel is small and the grains are large), at the directions that the lens really sends there, and its intensity is
integrated, not sampled. A plain mean over the points would leave 2 % of the grains' contrast: the weights are those
that integrate best over the frequencies that the pupil passes, and take in one point of each neighbour.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array
from rigs.simulated.image_plane import ImagePlane
from rigs.simulated.pupil import Complex, PupilGrid

# Distance of the points, of a speckle grain: the integral over a pixel is then right to 0.3 to 0.9 % rms (tested).
# Where the panel's edges and not the round pupil make the grain, its spectrum is fuller at high frequencies.
GRAIN_SHARE, GRAIN_SHARE_PANEL = 0.82, 0.65
SMALL_PANEL = 0.75  # of the pupil: light of one direction that fills less of it is cut by the panel's edges


@dataclass(frozen=True)
class Lens:
    """The camera's own geometry: what direction each pixel looks along.

    A rectilinear picture of `field_rad` full width, square pixels, turned by `rotation_rad` (positive: the camera turns
    from +x towards +y) and distorted radially as OpenCV has it: what lies at the tangent r is seen at
    r (1 + k1 r^2 + k2 r^4).
    """

    width: int
    height: int
    field_rad: float
    rotation_rad: float = 0.0
    k1: float = 0.0
    k2: float = 0.0

    def tangents(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Return the tangents in P, of the shape of the arguments, that the picture points (pixels) look along.

        Pixel centres are whole numbers; row 0 is on top.
        """
        half = np.tan(self.field_rad / 2)
        u = (2 * columns + 1 - self.width) / self.width * half
        v = (self.height - 1 - 2 * rows) / self.width * half
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        turned_x, turned_y = c * u - s * v, s * u + c * v
        if not (self.k1 or self.k2):
            return turned_x, turned_y
        r = np.hypot(u, v)
        ideal = r.copy()
        for _ in range(12):  # Newton: the distortion is given forward, this is its inverse
            sq = ideal * ideal
            value = ideal * (1 + self.k1 * sq + self.k2 * sq * sq) - r
            ideal -= value / np.maximum(1 + 3 * self.k1 * sq + 5 * self.k2 * sq * sq, 0.1)
        scale = np.where(r > 0, ideal / np.where(r > 0, r, 1.0), 1.0)
        return scale * turned_x, scale * turned_y


class PupilToPicture:
    """The map from the field in the pupil to the power on every pixel, for one wavelength, lens and focus.

    `reach_m` is the widest part of the pupil, along x and y, that light of one direction fills: a small panel fills
    less than all.
    """

    def __init__(
        self,
        grid: PupilGrid,
        lens: Lens,
        wavelength_m: float,
        *,
        focus_m: float = np.inf,
        reach_m: tuple[float, float] = (np.inf, np.inf),
    ) -> None:
        self.lens = lens
        edges = _direction_sines(lens, *(np.arange(size + 1.0) - 0.5 for size in (lens.width, lens.height)))
        self._plane = plane = ImagePlane(grid, wavelength_m, edges, focus_m=focus_m)
        self._per_pixel = (_solid_angle(edges) * plane.power_per_square).astype(np.float32)
        self._seen = _lit_part(plane.phases(edges)[2])
        grains = self._grains(grid, reach_m, wavelength_m)
        self._points = [points_per_pixel(*g) for g in grains]
        self._weights = [pixel_weights(n, g) for n, (g, _) in zip(self._points, grains, strict=True)]
        columns, rows = (_points(part, n) for part, n in zip(self._seen, self._points, strict=True))
        shape = (len(rows), len(columns))
        x, y, lit = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_)

        def locate(low: int) -> None:  # in bands: the whole picture in float64 would be half a gigabyte
            band = slice(low, low + 64)
            x[band], y[band], lit[band] = plane.phases(_direction_sines(lens, columns, rows[band]))

        with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
            list(pool.map(locate, range(0, shape[0], 64)))
        self._plan = plane.plan(x.ravel(), y.ravel())
        self._lit = None if lit.all() else torch.from_numpy(lit)
        self._out = np.empty(shape, np.complex64)

    def _grains(self, grid: PupilGrid, reach_m: tuple[float, float], wavelength_m: float) -> list[tuple[float, float]]:
        """Return, across the picture and down, the speckle grains in a pixel and how far apart points may lie."""
        widths = float(grid.x_m[-1] - grid.x_m[0]), float(grid.y_m[-1] - grid.y_m[0])
        c, s = abs(np.cos(self.lens.rotation_rad)), abs(np.sin(self.lens.rotation_rad))
        turned = (c * reach_m[0] + s * reach_m[1], s * reach_m[0] + c * reach_m[1]) if s else reach_m
        pixel = 2 * np.tan(self.lens.field_rad / 2) / self.lens.width
        return [
            (
                pixel * min(reach, width) / wavelength_m,
                GRAIN_SHARE if reach >= SMALL_PANEL * width else GRAIN_SHARE_PANEL,
            )
            for reach, width in zip(turned, widths, strict=True)
        ]

    def power(self, field: Complex) -> NDArray[np.float32]:
        """Return the power on every pixel, (height, width), of a field as `PanelToPupil.field` gives it."""
        self._plan.execute(self._plane.spectrum(field), out=self._out.ravel())
        out = torch.from_numpy(self._out)
        if self._lit is not None:
            out.mul_(self._lit)
        squares = torch.view_as_real(out).square_().flatten(1)
        (columns, rows), (across, down) = self._seen, self._points
        height = rows.stop - rows.start
        lines = torch.zeros((height, squares.shape[1]))
        for k, weight in enumerate(self._weights[1].tolist()):
            lines.add_(squares[k : k + down * (height - 1) + 1 : down], alpha=weight)
        both = torch.from_numpy(np.repeat(self._weights[0], 2))  # for real and imaginary parts
        picture = np.zeros((self.lens.height, self.lens.width), np.float32)
        picture[rows, columns] = (lines.unfold(1, len(both), 2 * across) @ both).numpy()
        picture *= self._per_pixel
        return picture


def _lit_part(corners: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the columns and rows of pixels of which any corner, (height + 1, width + 1), is lit; at least one each."""
    pixels = corners[1:, 1:] | corners[1:, :-1] | corners[:-1, 1:] | corners[:-1, :-1]
    parts = []
    for axis in (0, 1):
        lit = np.flatnonzero(pixels.any(axis=axis))
        parts.append(slice(int(lit[0]), int(lit[-1]) + 1) if lit.size else slice(0, 1))
    return parts[0], parts[1]


def _points(pixels: slice, per_pixel: int) -> Array:
    """Return evenly spaced points of these pixels, and one more on either side."""
    count = (pixels.stop - pixels.start) * per_pixel + 2
    return np.asarray(pixels.start - 0.5 + (np.arange(count, dtype=np.float64) - 0.5) / per_pixel)


def points_per_pixel(grains: float, share: float) -> int:
    """Return how many points a pixel of so many speckle grains needs, no further apart than this share of one."""
    return max(2, int(np.ceil(grains / share)))


def pixel_weights(points: int, grains: float) -> NDArray[np.float32]:
    """Return the weights, (points + 2,), that integrate an intensity over a pixel from evenly spaced values of it.

    The outermost two belong to the neighbouring pixels. They are the least squares over the frequencies that are there,
    up to `grains` cycles per pixel and rarer towards them; the mean is exact.
    """
    place = (np.arange(points + 2) - (points + 1) / 2) / points
    frequency = (np.arange(400) + 0.5) / 400 * grains
    rare = 1 - frequency / grains
    waves = np.cos(2 * np.pi * np.outer(frequency, place)) * rare[:, None]
    system = np.concatenate([waves, np.full((1, len(place)), 1e4)])
    wanted = np.append(np.sinc(frequency) * rare, 1e4)
    found = np.linalg.lstsq(system, wanted, rcond=None)[0]  # of least norm, and so symmetric
    return np.asarray(found / found.sum(), np.float32)


def _direction_sines(lens: Lens, columns: Array, rows: Array) -> tuple[Array, Array]:
    """Return the direction sines in P, (rows, columns) each, that picture points look along."""
    tan_x, tan_y = lens.tangents(*np.meshgrid(columns, rows))
    cosine = 1 / np.sqrt(1 + tan_x**2 + tan_y**2)
    return tan_x * cosine, tan_y * cosine


def _solid_angle(corners: tuple[Array, Array]) -> Array:
    """Return d^2 s of every pixel, (height, width), from the direction sines of all corners."""
    x, y = corners
    across, down = (np.diff(x, axis=1), np.diff(y, axis=1)), (np.diff(x, axis=0), np.diff(y, axis=0))
    mean_x, mean_y = ((a[1:] + a[:-1]) / 2 for a in across)
    step_x, step_y = ((d[:, 1:] + d[:, :-1]) / 2 for d in down)
    return np.abs(mean_x * step_y - mean_y * step_x)
