"""What the sensor makes of the light: electrons with their noise, then counts."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

Image = NDArray[np.float32]

BANDS = 8  # of rows, each with noise of its own stream: the same on one thread and on many
# Electrons from which the Cornish-Fisher expansion draws for Poisson's law: their distributions differ by 1e-4 at most
# there, a tenth of what a whole frame of 750 x 750 pixels could tell (tests/physics/test_simulated_sensor.py).
MANY_E = 100.0


@dataclass(frozen=True)
class Sensor:
    """A sensor: `bits` of counts over `full_well_e` electrons; noise in electrons, dark current in electrons/s.

    `hot_pixels` is how many pixels have 100 to 10,000 times the dark current (at least 100 e/s), at places that belong
    to the rig's seed. `psf_px` is the rms width of the lens's own blur.
    """

    width: int
    height: int
    bits: int
    full_well_e: float
    read_noise_e: float
    dark_e_per_s: float
    shot_noise: bool
    hot_pixels: int
    psf_px: float
    seed: int

    @property
    def full_scale(self) -> int:
        """The largest count."""
        return int(2**self.bits - 1)

    @property
    def offset_e(self) -> float:
        """What every pixel reads without light, in electrons, so that the noise of a dark frame is not cut at zero."""
        return 4 * self.read_noise_e

    @cached_property
    def dark_current(self) -> Image:
        """The dark current of every pixel, (height, width) electrons per second."""
        rng = np.random.default_rng([self.seed, 0x407])
        dark = np.full(self.width * self.height, self.dark_e_per_s, np.float32)
        hot = rng.choice(dark.size, size=min(self.hot_pixels, dark.size), replace=False)
        dark[hot] = np.maximum(dark[hot], 1.0) * 10 ** rng.uniform(2, 4, hot.size)
        return dark.reshape(self.height, self.width)

    def expose(self, rate_e_per_s: Image, exposure_s: float, key: tuple[object, ...]) -> NDArray[np.uint16]:
        """Return the counts, (height, width), of light that makes `rate_e_per_s` photo-electrons on every pixel.

        The noise is a function of the rig's seed and of `key`, which says what was shown and the how-manieth grab of it
        this is: the same frame is the same whatever was grabbed before it.
        """
        if self.psf_px > 0:
            rate_e_per_s = cv2.GaussianBlur(rate_e_per_s, (0, 0), self.psf_px, borderType=cv2.BORDER_REFLECT_101)
        counts = np.empty((self.height, self.width), np.uint16)
        dark = self.dark_current

        def read(band: int) -> None:
            rows = slice(self.height * band // BANDS, self.height * (band + 1) // BANDS)
            mean = (rate_e_per_s[rows] + dark[rows]) * np.float32(exposure_s)
            counts[rows] = self._count(mean, stream(self.seed, key, band))

        with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
            list(pool.map(read, range(BANDS)))
        return counts

    def _count(self, mean_e: Image, rng: np.random.Generator) -> NDArray[np.uint16]:
        electrons = _poisson(mean_e, rng) if self.shot_noise else mean_e
        if self.read_noise_e > 0:
            noise = rng.standard_normal(mean_e.shape, dtype=np.float32)
            noise *= np.float32(self.read_noise_e)
            electrons += noise
        np.minimum(electrons, np.float32(self.full_well_e), out=electrons)
        electrons += np.float32(self.offset_e)
        electrons *= np.float32(self.full_scale / self.full_well_e)
        np.rint(electrons, out=electrons)
        return np.clip(electrons, 0, self.full_scale, out=electrons).astype(np.uint16)


def stream(seed: int, key: tuple[object, ...], part: int) -> np.random.Generator:
    """Return the random numbers that belong to a rig's seed, a frame's key and a part of it."""
    words = np.frombuffer(hashlib.sha256(repr(key).encode()).digest(), np.uint32)
    return np.random.Generator(np.random.SFC64([seed, *(int(word) for word in words), part]))


def _poisson(mean: Image, rng: np.random.Generator) -> Image:
    """Return Poisson draws, whole numbers; from `MANY_E` on by the Cornish-Fisher expansion to second order."""
    z = rng.standard_normal(mean.shape, dtype=np.float32)
    root = np.sqrt(np.maximum(mean, np.float32(MANY_E)))
    square = z * z
    draws = mean + root * z
    draws += (square - 1) * np.float32(1 / 6)
    draws += (z - z * square) / (72 * root)
    np.rint(draws, out=draws)
    few = mean < MANY_E
    if few.any():
        draws[few] = rng.poisson(np.maximum(mean[few], 0.0))
    return np.asarray(draws, np.float32)
