"""Pictures whose truth is known: a smooth field, correlated speckle, a camera. No hologram is computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]


def generator(*seed: int) -> np.random.Generator:
    """Return numbers that are the same on every machine."""
    return np.random.Generator(np.random.PCG64(list(seed)))


def uneven_field(height: int, width: int, *, ratio: float = 4.0) -> Array:
    """Return a smooth field from 1 / ratio to 1: brightest right of the middle and above it, skewed, no symmetry."""
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    log = -((x - 0.3) ** 2) - 0.7 * (y + 0.2) ** 2 + 0.25 * x * y + 0.15 * np.sin(2.5 * x + 1.2 * y)
    log -= log.max()
    return np.asarray(np.exp(log * np.log(ratio) / -log.min()))


def speckle(rng: np.random.Generator, height: int, width: int, *, contrast: float, grain_px: float) -> Array:
    """Return speckle of mean 1: a sum of intensities of independent complex Gaussian fields, gamma-like.

    `grain_px` is the full 1/e width of the intensity's correlation; 0 is one grain per pixel.
    """
    count = max(1, int(np.ceil(contrast**-2 - 1e-9)))
    share = np.full(count, 1 / count)
    if count > 1:  # one field brighter than the others so that the squares of the shares sum to contrast**2
        share[0] += np.sqrt(max(contrast**2 - 1 / count, 0) * (count - 1) / count)
        share[1:] = (1 - share[0]) / (count - 1)
    total = np.zeros((height, width))
    for part in share:
        waves = rng.standard_normal((2, height, width))
        if grain_px > 0:  # the amplitude's correlation is exp(-r^2 / (4 sigma^2)), the intensity's its square
            sigma = grain_px / 2 / np.sqrt(2)
            waves = np.stack([gaussian_filter(wave, sigma, mode="wrap") for wave in waves])
            waves /= np.sqrt(np.mean(waves**2))
        total += part * np.sum(waves**2, axis=0) / 2
    return total


def frames_of(
    field: Array, seed: int, count: int, *, contrast: float = 0.45, grain_px: float = 0.0, counts: float = 400.0
) -> Array:
    """Return `count` pictures of a field with independent speckle, (count, height, width), the dark subtracted."""
    rng = generator(seed)
    return np.stack(
        [counts * field * speckle(rng, *field.shape, contrast=contrast, grain_px=grain_px) for _ in range(count)]
    )
