"""What the sensor makes of the light: electrons with their noise, then counts."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


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

    def dark_current(self) -> Image:
        """Return the dark current of every pixel, (height, width) electrons per second."""
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
        mean = (rate_e_per_s + self.dark_current()) * np.float32(exposure_s)
        words = np.frombuffer(hashlib.sha256(repr(key).encode()).digest(), np.uint32)
        rng = np.random.default_rng([self.seed, *(int(word) for word in words)])
        electrons = _poisson(mean, rng) if self.shot_noise else mean
        if self.read_noise_e > 0:
            electrons = electrons + self.read_noise_e * rng.standard_normal(mean.shape, dtype=np.float32)
        offset = np.float32(4 * self.read_noise_e)  # electrons, so that the noise of a dark frame is not cut at zero
        counts = np.rint((np.minimum(electrons, self.full_well_e) + offset) * (self.full_scale / self.full_well_e))
        return np.asarray(np.clip(counts, 0, self.full_scale), np.uint16)


def _poisson(mean: Image, rng: np.random.Generator) -> Image:
    """Return Poisson draws; above 1e4 the Gaussian of the same mean and variance, which no counter can tell apart."""
    bright = mean > 1e4
    draws = rng.poisson(np.where(bright, 0.0, np.maximum(mean, 0.0))).astype(np.float32)
    if bright.any():
        large = mean[bright]
        draws[bright] = large + np.sqrt(large) * rng.standard_normal(large.shape, dtype=np.float32)
    return draws
