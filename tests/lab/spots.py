"""Pictures of spots behind a cut pupil, for tests: a sum over the pupil, a coarse camera, its noise.

Nothing of the package's own propagation is used: the far field of every zone is a plain sum over its pupil's points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.zernike import zernike

Array = NDArray[np.float64]

WAVELENGTH_M = 515e-9
PUPIL_RADIUS_M = 1.5e-3
PIXEL_RAD = 5.8e-4
PIXEL_GRADIENT = 2 * np.pi * PUPIL_RADIUS_M * PIXEL_RAD / WAVELENGTH_M  # rad per pupil radius that move by one pixel
POINTS = 144  # across 2.2 radii: the background then repeats after 42 pixels, more than a window
FINER = 8  # samples per pixel and axis: a grain of light is 0.29 pixel, its picture needs 6.8 samples a pixel
FULL_SCALE = 4095.0
ELECTRONS_PER_COUNT = 10000.0 / FULL_SCALE
READ_ELECTRONS = 6.0


@dataclass(frozen=True)
class Cut:
    """A rectangle that lights a part of the pupil: its middle and its sides in m; `fall` is the amplitude's, over y."""

    x_m: float = 0.0
    y_m: float = 0.0
    width_m: float = 3.6e-3
    height_m: float = 2.0e-3
    fall: float = 2.0

    def amplitude(self) -> tuple[Array, Array, Array]:
        """Return x, y in radii (POINTS, POINTS) and the amplitude there."""
        axis = (np.arange(POINTS) - (POINTS - 1) / 2) * 2.2 / POINTS
        x, y = np.meshgrid(axis, axis)
        step = 2.2 / POINTS
        rim = np.clip((1.0 - np.hypot(x, y)) / (0.2e-3 / PUPIL_RADIUS_M) + 0.5, 0.0, 1.0)
        soft = np.sin(np.pi / 2 * rim) ** 2

        def side(at: Array, middle_m: float, length_m: float) -> Array:
            off = length_m / 2 - np.abs(at * PUPIL_RADIUS_M - middle_m)
            return np.clip(off / (step * PUPIL_RADIUS_M) + 0.5, 0.0, 1.0)  # the share of a point's square that is lit

        inside = side(x, self.x_m, self.width_m) * side(y, self.y_m, self.height_m)
        along = (y * PUPIL_RADIUS_M - self.y_m) / self.height_m
        return x, y, soft * inside * self.fall ** (-np.clip(along, -0.5, 0.5))


class Spots:
    """Takes pictures of spots, one per zone, whose aberrations and places it knows."""

    def __init__(
        self,
        cuts: Sequence[Cut],
        noll: Sequence[int],
        truth_rad: Array,
        *,
        seed: int,
        window: int = 41,
        noise: bool = True,
        background: float = 0.015,
        brightness: float = 0.7,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.noll, self.noise, self.background, self.brightness = tuple(noll), noise, background, brightness
        self.pupils = [cut.amplitude() for cut in cuts]
        self.truth_rad = truth_rad
        self.place = self.rng.uniform(-0.8, 0.8, (len(cuts), 2))  # px
        at = (np.arange(window * FINER) - (window * FINER - 1) / 2) / FINER * PIXEL_GRADIENT
        axis = self.pupils[0][0][0]
        self.kernel = np.exp(-1j * at[:, None] * axis[None, :]).astype(np.complex64)
        self.hot = self.rng.random((len(cuts), window, window)) < 0.002
        self.dead = np.zeros(len(cuts), bool)
        self.frames = 0

    def lit(self) -> list[tuple[Array, Array, Array]]:
        """Return x, y and the intensity of every zone's lit points."""
        return [(x[a > 0], y[a > 0], a[a > 0] ** 2) for x, y, a in self.pupils]

    def picture(self, zone: int, added_rad: Array, noll: Sequence[int]) -> Array:
        """Return the light of one zone's window as the pixels sum it, the spot's total being about 1."""
        x, y, amplitude = self.pupils[zone]
        phase = np.tensordot(self.truth_rad[zone], zernike(self.noll, x, y), 1)
        phase += np.tensordot(added_rad, zernike(noll, x, y), 1)
        phase += PIXEL_GRADIENT * (self.place[zone, 0] * x + self.place[zone, 1] * y)
        field = amplitude * np.exp(1j * phase)
        if self.background:
            shape = (*field.shape, 2)
            grain = self.rng.normal(0.0, 1.0, shape) @ np.array([1.0, 1j])
            power = (np.abs(amplitude * grain) ** 2).sum()
            field = field + amplitude * grain * np.sqrt(self.background * (amplitude**2).sum() / power)
        far = self.kernel @ field.astype(np.complex64) @ self.kernel.T
        light = np.abs(far) ** 2
        side = light.shape[0] // FINER
        total = (amplitude**2).sum() * self.kernel.shape[1] * self.kernel.shape[1]
        return np.asarray(light.reshape(side, FINER, side, FINER).sum(axis=(1, 3)) / total, np.float64)

    def windows(self, added_rad: Array, noll: Sequence[int]) -> tuple[Array, NDArray[np.bool_]]:
        """Return dark-subtracted counts (zones, h, w) of one frame and where its pixels are usable."""
        self.frames += 1
        light = np.stack([self.picture(z, added_rad[z], noll) for z in range(len(self.pupils))])
        light[self.dead] = 0.0
        peak = light.max(axis=(1, 2), keepdims=True)
        electrons = self.brightness * 10000.0 * light / np.where(peak > 0, peak, 1.0)
        electrons *= 1 + 0.01 * self.rng.normal(size=(len(light), 1, 1)) * self.noise
        if self.noise:
            electrons = self.rng.poisson(electrons) + self.rng.normal(0.0, READ_ELECTRONS, light.shape)
        dark = 64.0
        counts = np.clip(np.rint(electrons / ELECTRONS_PER_COUNT + dark), 0, FULL_SCALE) - dark
        counts[self.hot] = self.rng.uniform(500, FULL_SCALE - dark, int(self.hot.sum()))
        return counts, ~self.hot


def rms_over_lit(lit: tuple[Array, Array, Array], coefficients_rad: Array, noll: Sequence[int]) -> float:
    """Return the rms of a wavefront over the lit part, piston and tilt removed, weighted with its intensity."""
    x, y, weight = lit
    root = np.sqrt(weight / weight.sum())
    plane = np.stack([np.ones_like(x), x, y], axis=1) * root[:, None]
    wave = (coefficients_rad @ zernike(noll, x, y)) * root
    return float(np.linalg.norm(wave - plane @ np.linalg.lstsq(plane, wave, rcond=None)[0]))
