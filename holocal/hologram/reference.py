"""The reference wave: what the panel would show for light that all passes through the pupil's centre.

Divided by it, a hologram's spectrum is an image of the pupil's plane (docs/physics.md 4): the signal fills a disc of
0.4 to 0.6 of the band, and the IFTA's signal window is that disc.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.hologram.settings import HologramSettings
from holocal.optics.bench import Array
from holocal.optics.phase_function import pupil_rim
from holocal.optics.raytrace import Connection, connect
from holocal.optics.series import Series, fit_series

# Degree 8 leaves 2e-4 rad on the nominal bench at gaze 0 and 3e-3 rad at a gaze of 13 degrees; 12 leaves 1e-5 rad.
_DEGREE = 12


def reference_turns(settings: HologramSettings) -> Series:
    """Return the reference's phase psi0 on the panel, in turns (2 pi rad): minus the path from the pupil's centre.

    Traced once (10 ms) for the last few settings.
    """
    return _reference_turns(settings.geometry())


@lru_cache(maxsize=4)
def _reference_turns(where: HologramSettings) -> Series:
    return fit_series(
        lambda slm_m: turns_at(where, slm_m), degree=_DEGREE, centre=(0.0, 0.0), half=where.panel.half_size_m
    )


def turns_at(settings: HologramSettings, slm_m: Array) -> Array:
    """Return the reference's phase at panel points (..., 2), turns, by tracing."""
    return -central_rays(settings, slm_m).path_m / settings.wavelength_m


def central_rays(settings: HologramSettings, slm_m: Array) -> Connection:
    """Return the rays from the pupil's centre to panel points (..., 2), or raise InputError where there is none."""
    found = connect(settings.bench, slm_m, np.zeros(2), gaze_rad=settings.gaze_rad)
    if not np.all(found.error_m < 1e-9):
        raise InputError(
            f"Rays from the pupil's centre to the panel land {float(np.nanmax(found.error_m)):.3g} m off.",
            fix="Check the bench's misalignment and the gaze.",
        )
    return found


@dataclass(frozen=True)
class PupilWindow:
    """The pupil's image in the spectrum of a hologram divided by the reference: a star-shaped region round 0.

    `radius_per_m` (n,) cycles per metre at angles 2 pi i / n from +x towards +y.
    """

    radius_per_m: Array

    def contains(self, fx_per_m: Array, fy_per_m: Array, margin_per_m: float = 0.0) -> NDArray[np.bool_]:
        """Return which frequencies are inside, (len(fy), len(fx))."""
        count = len(self.radius_per_m)
        fx, fy = fx_per_m[None, :], fy_per_m[:, None]
        place = np.mod(np.arctan2(fy, fx) / (2 * np.pi), 1.0) * count
        low = np.floor(place).astype(int) % count
        part = place - np.floor(place)
        radius = self.radius_per_m[low] * (1 - part) + self.radius_per_m[(low + 1) % count] * part
        return np.asarray(np.hypot(fx, fy) <= radius + margin_per_m)

    @property
    def half_size_per_m(self) -> tuple[float, float]:
        """Largest |fx| and |fy| inside."""
        angle = 2 * np.pi * np.arange(len(self.radius_per_m)) / len(self.radius_per_m)
        return (
            float(np.max(self.radius_per_m * np.abs(np.cos(angle)))),
            float(np.max(self.radius_per_m * np.abs(np.sin(angle)))),
        )


def pupil_window(settings: HologramSettings, *, rim: int = 96, samples: tuple[int, int] = (7, 5)) -> PupilWindow:
    """Return the union, over the panel's points, of the pupil's image in frequency.

    At a panel point x, light for the pupil point q has the frequency (s(x, q) - s(x, 0)) / lambda, s being the sideways
    part of the direction in which it leaves the panel.
    """
    bench = settings.bench
    half_x, half_y = settings.panel.half_size_m
    slm = np.stack(np.meshgrid(np.linspace(-half_x, half_x, samples[0]), np.linspace(-half_y, half_y, samples[1])), -1)
    slm = slm.reshape(-1, 1, 2)
    edge = pupil_rim(bench.pupil_diameter_m, rim)
    towards = connect(bench, slm, edge, gaze_rad=settings.gaze_rad).slm_direction[..., :2]
    centre = connect(bench, slm, np.zeros(2), gaze_rad=settings.gaze_rad).slm_direction[..., :2]
    frequency = (towards - centre) / settings.wavelength_m
    angle = np.mod(np.arctan2(frequency[..., 1], frequency[..., 0]), 2 * np.pi)
    radius = np.linalg.norm(frequency, axis=-1)
    at = 2 * np.pi * np.arange(4 * rim) / (4 * rim)
    each = [np.interp(at, a, r, period=2 * np.pi) for a, r in zip(angle, radius, strict=True)]
    return PupilWindow(np.max(each, axis=0))
