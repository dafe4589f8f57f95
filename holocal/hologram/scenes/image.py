"""An image as a grid of luminous points (thesis 3.1): amplitudes are square roots of intensities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from holocal.errors import InputError
from holocal.hologram.scenes.points import PointCloud
from holocal.optics.bench import Array, image_tangents

_MOST_POINTS = 64_000_000  # an 8000 x 8000 image; more than the panel could ever resolve


class InitialPhase(Protocol):
    """The phase each point starts with: a function of the grid of points."""

    def __call__(self, x_tan: Array, y_tan: Array) -> Array:
        """Return phases (len(y_tan), len(x_tan)) in radians."""
        ...


@dataclass(frozen=True)
class RandomPhase:
    """Uniform in [0, 2 pi), from a seed: spreads the light evenly over the pupil, at the price of speckle."""

    seed: int

    def __call__(self, x_tan: Array, y_tan: Array) -> Array:
        """Return phases (len(y_tan), len(x_tan)) in radians."""
        return np.random.default_rng(self.seed).random((len(y_tan), len(x_tan))) * (2 * np.pi)


@dataclass(frozen=True)
class ZeroPhase:
    """The same phase everywhere: no speckle, but all light crosses the pupil near its centre."""

    def __call__(self, x_tan: Array, y_tan: Array) -> Array:
        """Return phases (len(y_tan), len(x_tan)) in radians."""
        return np.zeros((len(y_tan), len(x_tan)))


def checked_intensity(intensity: ArrayLike) -> NDArray[np.float64]:
    """Return the image as float64 (rows, columns), or raise InputError naming what is wrong with it."""
    image = np.asarray(intensity)
    if image.ndim != 2 or image.size == 0:
        raise InputError(
            f"The image has shape {image.shape}; it must be (rows, columns) with at least one pixel.",
            fix="Give one colour channel at a time.",
        )
    if image.size > _MOST_POINTS:
        raise InputError(
            f"The image has {image.size} pixels.", fix="Scale it down.", measured=image.size, limit=_MOST_POINTS
        )
    if np.iscomplexobj(image) or image.dtype.kind not in "buif":
        raise InputError(f"The image's values are of type {image.dtype}; intensities are real numbers.")
    image = image.astype(np.float64)
    if not np.all(np.isfinite(image)):
        raise InputError(f"{int(np.sum(~np.isfinite(image)))} pixels of the image are not finite.")
    if image.min() < 0:
        raise InputError(f"The image's smallest value is {image.min():g}; an intensity is not negative.", limit=0.0)
    return image


def image_cloud(
    intensity: ArrayLike, *, fov_rad: tuple[float, float], depth_m: float = np.inf, initial_phase: InitialPhase
) -> PointCloud:
    """Return the points of an image (rows, columns) of intensities that covers `fov_rad`, centred on the gaze.

    One point per pixel, row by row from the top, at `depth_m` from the pupil's centre. The amplitude is
    sqrt(intensity), whatever the scale; the phase is `initial_phase` of the grid.
    """
    image = checked_intensity(intensity)
    x, y = image_tangents(image.shape[1], image.shape[0], fov_rad)
    return PointCloud(
        np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2),
        np.full(image.size, depth_m),
        np.sqrt(image).ravel(),
        initial_phase(x, y).ravel(),
    )
