"""Points: what every scene becomes before it is a hologram (thesis 1.2: points, polygons, rays and layers alike)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from holocal.errors import InputError
from holocal.optics.bench import Array

_NEAREST_M = 1e-6  # a point nearer than a few waves to the pupil is not seen through it
_WIDEST_TAN = 1e6  # 0.2 seconds of arc from a right angle
_LARGEST_PHASE = 1e9  # rad: float64 holds it to 1e-7


@dataclass(frozen=True)
class Aperture:
    """A disc of the pupil: `centre_m` (x, y) in P and `diameter_m`. A view of a light field is seen through one."""

    centre_m: tuple[float, float]
    diameter_m: float


@dataclass(frozen=True)
class PointCloud:
    """Luminous points, coherent with each other.

    A cloud with any light has tangents up to 1e6, distances from 1e-6 m and phases up to 1e9 rad.

    Parameters
    ----------
    field_tan
        (n, 2) tangents of their directions in the pupil's frame P (x towards the panel, y up), relative to the gaze.
    distance_m
        (n,) metres from the pupil's centre, above 0; infinity is one.
    amplitude
        (n,) square roots of intensities, finite, not negative.
    phase_rad
        (n,) initial phases.
    aperture
        The part of the pupil that they are to be seen through; None is the whole pupil.
    """

    field_tan: Array
    distance_m: Array
    amplitude: Array
    phase_rad: Array
    aperture: Aperture | None = None

    def __post_init__(self) -> None:
        count = len(self.amplitude)
        shapes = (self.field_tan.shape, self.distance_m.shape, self.amplitude.shape, self.phase_rad.shape)
        if shapes != ((count, 2), (count,), (count,), (count,)):
            raise InputError(f"The points' arrays have the shapes {shapes}; they must be (n, 2), (n,), (n,), (n,).")
        if not (np.all(np.isfinite(self.field_tan)) and np.all(np.isfinite(self.phase_rad))):
            raise InputError("A point's direction or phase is not finite.", fix="Remove it from the scene.")
        if not np.all(self.distance_m > 0):  # NaN too
            raise InputError(
                f"{int(np.sum(~(self.distance_m > 0)))} points are at or behind the eye.",
                fix="Distances are metres in front of the pupil, above 0; infinity is one.",
                limit=0.0,
            )
        if not (np.all(np.isfinite(self.amplitude)) and np.all(self.amplitude >= 0)):
            raise InputError("A point's amplitude is negative or not finite.", limit=0.0)
        if np.any(self.amplitude > 0):
            self._check_places()

    def _check_places(self) -> None:
        """Refuse points whose light float64 cannot follow: their phases would be noise, and nothing would say so."""
        for what, unit, value, least, most in (
            ("tangent", "", float(np.abs(self.field_tan).max()), 0.0, _WIDEST_TAN),
            ("initial phase", " rad", float(np.abs(self.phase_rad).max()), 0.0, _LARGEST_PHASE),
            ("distance", " m", float(self.distance_m.min()), _NEAREST_M, np.inf),
        ):
            if not least <= value <= most:
                limit = most if value > most else least
                raise InputError(
                    f"A point's {what} is {value:.3g}{unit}; the limit is {limit:.3g}{unit}.",
                    fix="Remove it from the scene.",
                    measured=value,
                    limit=limit,
                )

    def __len__(self) -> int:
        return len(self.amplitude)

    def lit(self) -> PointCloud:
        """Return the points that have light."""
        return self.part(np.flatnonzero(self.amplitude > 0))

    def part(self, index: np.ndarray[tuple[int], np.dtype[np.intp]]) -> PointCloud:
        """Return the points of an index array."""
        return PointCloud(
            self.field_tan[index],
            self.distance_m[index],
            self.amplitude[index],
            self.phase_rad[index],
            self.aperture,
        )
