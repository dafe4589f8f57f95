"""What the camera's lens makes of the field in the pupil: the power on every pixel.

    E(s) = 1 / wavelength  sum_q  U(q) exp(i k q . s)        s = direction sines in P; |E|^2 = power per unit of d^2 s

A speckle grain is 0.3 pixel (docs/physics.md 6), so the field is computed at 4 x 4 points in every pixel (fewer where
the panel is small and the grains are large), at the directions that the lens really sends there, and its intensity is
integrated, not sampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array
from rigs.simulated.pupil import Complex, PupilGrid, unit_phase

GRAIN_SHARE = 0.92  # of a speckle grain: the distance of the points; 4 per pixel for the 4K panel and a pupil of 3 mm
NUFFT_EPS = 1e-3  # relative, of the field


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
        r = np.hypot(u, v)
        ideal = r.copy()
        for _ in range(12 if self.k1 or self.k2 else 0):  # Newton: the distortion is given forward, this is its inverse
            sq = ideal * ideal
            value = ideal * (1 + self.k1 * sq + self.k2 * sq * sq) - r
            ideal -= value / np.maximum(1 + 3 * self.k1 * sq + 5 * self.k2 * sq * sq, 0.1)
        scale = np.where(r > 0, ideal / np.where(r > 0, r, 1.0), 1.0)
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        return scale * (c * u - s * v), scale * (s * u + c * v)


class PupilToPicture:
    """The map from the field in the pupil to the power on every pixel, for one wavelength, lens and focus.

    `reach_m` is the widest part of the pupil that light of one direction fills: a small panel fills less than all.
    """

    def __init__(
        self, grid: PupilGrid, lens: Lens, wavelength_m: float, *, focus_m: float = np.inf, reach_m: float = np.inf
    ) -> None:
        import finufft

        self.lens = lens
        k = 2 * np.pi / wavelength_m
        grain = wavelength_m / min(reach_m, grid.x_m[-1] - grid.x_m[0])
        pixel = 2 * np.tan(lens.field_rad / 2) / lens.width
        n = self._subsamples = max(2, int(np.ceil(pixel / (GRAIN_SHARE * grain))))
        shape = (lens.height * n, lens.width * n)
        columns = (np.arange(shape[1]) + 0.5) / n - 0.5
        rows = (np.arange(shape[0]) + 0.5) / n - 0.5
        phases = np.empty((2, *shape), np.float32)
        self._lit = np.empty(shape, np.bool_)
        for low in range(0, shape[0], 256):  # in bands: the whole picture in float64 would be half a gigabyte
            band = slice(low, low + 256)
            sines = _direction_sines(lens, columns, rows[band])
            for out, sine, pitch, carrier in zip(phases, sines, grid.pitch_m, grid.carrier, strict=True):
                out[band] = k * pitch * (sine - carrier)
            # The panel sends no light further than half a period of the fine grid: what lies beyond is dark.
            self._lit[band] = (np.abs(phases[:, band]) <= np.pi).all(axis=0)
        phases[:, ~self._lit] = 0.0
        self._plan = finufft.Plan(
            2,
            (len(grid.x_m), len(grid.y_m)),
            eps=NUFFT_EPS,
            isign=1,
            upsampfac=1.25,  # half the memory of 2, and no slower
            dtype="complex64",
            nthreads=torch.get_num_threads(),
        )
        self._plan.setpts(phases[0].ravel(), phases[1].ravel())
        cell = grid.pitch_m[0] * grid.pitch_m[1] / wavelength_m
        self._per_pixel = (_pixel_solid_angle(lens) * cell**2).astype(np.float32)
        self._focus: Complex | None = None
        if np.isfinite(focus_m):
            x, y = grid.x_m[:, None], grid.y_m[None]
            # what a point at that distance sends, exp(+i k |p - q|), is made flat
            self._focus = unit_phase(-k * (x * x + y * y) / (np.sqrt(focus_m**2 + x * x + y * y) + focus_m))

    def power(self, field: Complex) -> NDArray[np.float32]:
        """Return the power on every pixel, (height, width), of a field as `PanelToPupil.field` gives it."""
        wave = field if self._focus is None else field * self._focus
        e = torch.from_numpy(self._plan.execute(np.ascontiguousarray(wave))).view(self._lit.shape)
        intensity = e.real.square().addcmul_(e.imag, e.imag).mul_(torch.from_numpy(self._lit)).numpy()
        mean = cv2.resize(intensity, (self.lens.width, self.lens.height), interpolation=cv2.INTER_AREA)
        return np.asarray(mean * self._per_pixel)


def _direction_sines(lens: Lens, columns: Array, rows: Array) -> tuple[Array, Array]:
    """Return the direction sines in P, (rows, columns) each, that picture points look along."""
    tan_x, tan_y = lens.tangents(*np.meshgrid(columns, rows))
    cosine = 1 / np.sqrt(1 + tan_x**2 + tan_y**2)
    return tan_x * cosine, tan_y * cosine


def _pixel_solid_angle(lens: Lens) -> Array:
    """Return d^2 s of every pixel, (height, width), from the direction sines of its corners."""
    edges_x, edges_y = (np.arange(n + 1, dtype=np.float64) - 0.5 for n in (lens.width, lens.height))
    x, y = _direction_sines(lens, edges_x, edges_y)
    across, down = (np.diff(x, axis=1), np.diff(y, axis=1)), (np.diff(x, axis=0), np.diff(y, axis=0))
    mean_x, mean_y = ((a[1:] + a[:-1]) / 2 for a in across)
    step_x, step_y = ((d[:, 1:] + d[:, :-1]) / 2 for d in down)
    return np.abs(mean_x * step_y - mean_y * step_x)
