"""An image as a grid of luminous points (thesis 3.1): amplitudes are square roots of intensities."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from holocal.errors import InputError
from holocal.hologram.scenes.points import PointCloud
from holocal.optics.bench import Array, image_tangents

_MOST_POINTS = 64_000_000  # an 8000 x 8000 image; more than the panel could ever resolve


class InitialPhase(Protocol):
    """The phase each point starts with: a function of the grid of points, or of points anywhere."""

    def __call__(self, x_tan: Array, y_tan: Array) -> Array:
        """Return phases (len(y_tan), len(x_tan)) in radians."""
        ...

    def at(self, field_tan: Array) -> Array:
        """Return phases (n,) in radians of points at tangents (n, 2); of a grid's, row by row, the grid's phases."""
        ...

    def of_layer(self, index: int) -> InitialPhase:
        """Return the phase of a scene's layer `index`, 0 being this one: unrelated to it where phases are random."""
        ...


@dataclass(frozen=True)
class RandomPhase:
    """Uniform in [0, 2 pi), from a seed: spreads the light evenly over the pupil, at the price of speckle.

    Equal seeds and layers give equal phases: to a grid by pixel, to scattered points in their order.
    """

    seed: int
    layer: int = 0

    def __call__(self, x_tan: Array, y_tan: Array) -> Array:
        """Return phases (len(y_tan), len(x_tan)) in radians."""
        return self._generator().random((len(y_tan), len(x_tan))) * (2 * np.pi)

    def at(self, field_tan: Array) -> Array:
        """Return phases (n,) in radians, in the points' order, wherever they are."""
        return self._generator().random(len(field_tan)) * (2 * np.pi)

    def of_layer(self, index: int) -> RandomPhase:
        """Return independent phases for each index."""
        return replace(self, layer=self.layer + index)

    def _generator(self) -> np.random.Generator:
        return np.random.default_rng((self.seed, self.layer) if self.layer else self.seed)


@dataclass(frozen=True)
class ZeroPhase:
    """The same phase everywhere: no speckle, but all light crosses the pupil near its centre."""

    def __call__(self, x_tan: Array, y_tan: Array) -> Array:
        """Return phases (len(y_tan), len(x_tan)) in radians."""
        return np.zeros((len(y_tan), len(x_tan)))

    def at(self, field_tan: Array) -> Array:
        """Return phases (n,) in radians."""
        return np.zeros(len(field_tan))

    def of_layer(self, index: int) -> ZeroPhase:
        """Return the same phase for each index."""
        return self


@dataclass(frozen=True)
class QuadraticPhase:
    """A smooth phase that sends the light of each part of the field through its own part of the pupil.

    A point in the direction s (sines) with the phase psi(s) crosses the pupil as exp(i (psi(s) - k q . s)), so that its
    eye sees E(s) = sum_q U(q) exp(i k q . s) (docs/physics.md 5). Neighbours add up where that phase is stationary:
    q = (1 / k) d psi / d s. With

        psi(s) = (pi / wavelength) c |s|^2,        |s|^2 = |t|^2 / (1 + |t|^2),        q = c s,

    the pupil holds a picture of the field, c metres per unit of s, upright. c is such that the field's corners come to
    `share` of the pupil's radius. No speckle; but a smooth area uses only its own place of the pupil, so that it is
    seen with great depth of focus, and dust there shows.

    The picture in the pupil repeats every wavelength / (spacing of the points): 0.87 mm for 750 points in 25 degrees
    at 515 nm. Only points closer than wavelength / (pupil diameter), 0.01 degrees for 3 mm, make it single.

    Parameters
    ----------
    wavelength_m
        Wavelength in metres.
    fov_rad
        Full angles (x, y) of the image.
    pupil_diameter_m
        The pupil's diameter.
    share
        Of the pupil's radius that the field's corners reach.
    """

    wavelength_m: float
    fov_rad: tuple[float, float]
    pupil_diameter_m: float
    share: float = 0.8

    @property
    def curvature_m(self) -> float:
        """Metres in the pupil per unit of direction sine: c."""
        corner = np.tan(self.fov_rad[0] / 2) ** 2 + np.tan(self.fov_rad[1] / 2) ** 2
        return float(self.share * self.pupil_diameter_m / 2 / np.sqrt(corner / (1 + corner)))

    def __call__(self, x_tan: Array, y_tan: Array) -> Array:
        """Return phases (len(y_tan), len(x_tan)) in radians."""
        return self._of(x_tan[None, :] ** 2 + y_tan[:, None] ** 2)

    def at(self, field_tan: Array) -> Array:
        """Return phases (n,) in radians."""
        return self._of(np.sum(field_tan**2, axis=-1))

    def of_layer(self, index: int) -> QuadraticPhase:
        """Return the same phase for each index."""
        return self

    def _of(self, tan_squared: Array) -> Array:
        return np.pi / self.wavelength_m * self.curvature_m * tan_squared / (1 + tan_squared)


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
