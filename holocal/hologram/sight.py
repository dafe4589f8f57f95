"""The panel as the centre of the pupil sees it: coordinates in which the pupil is an exact mask.

With s(x) the direction sines, in P, along which the pupil's centre sees the panel point x, and L the path,

    -k [L(x, q) - L(x, 0)] = b(q) + u(q) . s(x) + rest,        u(q) close to k q,

and the rest is 3 rad rms of 1200 over the whole panel and pupil. A hologram divided by the reference -k L(x, 0) and
sampled evenly in s has therefore the pupil for its spectrum, wherever on the panel: the footprint A_p(x) of every
point at once is one mask. On the panel itself the pupil's image grows by half from one side to the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from holocal.hologram.reference import central_rays, turns_at
from holocal.hologram.settings import HologramSettings
from holocal.optics.bench import Array
from holocal.optics.phase_function import VirtualPoints, pupil_grid, trace_points
from holocal.optics.raytrace import connect
from holocal.optics.series import Series, fit_series

_DEGREE = 10  # of s(x) and x(s): 1e-9 m over the 4K panel and 10 % beyond
_REFERENCE_DEGREE = 12  # 1e-5 rad on the nominal bench up to a gaze of 13 degrees
_PUPIL_DEGREE = 3  # of u(q) and q(u): the rest moves the rim by less than 1e-3 of the radius
_PUPIL_TERMS = tuple((i, j) for i in range(_PUPIL_DEGREE + 1) for j in range(_PUPIL_DEGREE + 1 - i))
_MARGIN = 1.06  # the rectangle of s is wider than the panel's by this much
_LEAST_GRAINS, _LEAST_SINE = 12, 0.1  # and its half at least 12 grains, wavelength / pupil: 26 pixels of 3.74 um


@dataclass(frozen=True)
class Sight:
    """Sight coordinates s, (2,) direction sines in P, of a panel and a gaze.

    Parameters
    ----------
    to_sight
        s over the panel's (x, y) in metres.
    to_panel
        x over the rectangle of s that holds the panel.
    reference_turns
        The reference -k L(x(s), 0) over the same rectangle, in turns.
    pupil_of
        Coefficients (terms, 2) of q / pupil radius over the products of `_pupil_basis` of u / (k pupil radius).
    pupil_radius_m, wavenumber
        Of the pupil, and k = 2 pi / wavelength.
    """

    to_sight: Series
    to_panel: Series
    reference_turns: Series
    pupil_of: Array
    pupil_radius_m: float
    wavenumber: float

    def panel(self, s: Array) -> Array:
        """Return the panel points (n, 2), metres, seen along s (n, 2)."""
        return self.to_panel.at(s)

    def reference_rad(self, s: Array) -> Array:
        """Return the reference's phase (n,), radians, at s (n, 2)."""
        return self.reference_turns.at(s) * (2 * np.pi)

    def pupil(self, frequency: Array) -> Array:
        """Return the pupil point (..., 2), metres in P, that light of frequency u (..., 2), rad per unit of s, crosses.

        Beyond twice the pupil's radius the point is clipped: nothing is known there, and no light is wanted.
        """
        unit = np.clip(frequency / (self.wavenumber * self.pupil_radius_m), -2, 2)
        return np.asarray((_pupil_basis(unit) @ self.pupil_of) * self.pupil_radius_m)

    def pupil_grid(self, u_x: Array, u_y: Array) -> Array:
        """Return `pupil` on the grid of u_x (w,) and u_y (h,), (h, w, 2)."""
        scale = self.wavenumber * self.pupil_radius_m
        powers_x, powers_y = (np.clip(u / scale, -2, 2)[:, None] ** np.arange(_PUPIL_DEGREE + 1) for u in (u_x, u_y))
        table = np.zeros((_PUPIL_DEGREE + 1, _PUPIL_DEGREE + 1, 2))
        for (i, j), row in zip(_PUPIL_TERMS, self.pupil_of, strict=True):
            table[j, i] = row
        return np.stack([powers_y @ table[..., axis] @ powers_x.T for axis in (0, 1)], axis=-1) * self.pupil_radius_m


def sight(settings: HologramSettings) -> Sight:
    """Return the sight coordinates of a setting; the rays of the pupil's centre are found once, to 1e-9 m."""
    bench, panel = settings.bench, settings.panel
    half = (panel.half_size_m[0], panel.half_size_m[1])

    def seen(slm_m: Array) -> Array:
        return sight_of(settings, slm_m)

    to_sight = fit_series(seen, degree=_DEGREE, centre=(0.0, 0.0), half=(half[0] * 1.1, half[1] * 1.1))
    edge = np.linspace(-1, 1, 33)
    rim = np.concatenate(
        [np.stack(np.broadcast_arrays(a, b), -1) for a, b in ((edge, 1), (edge, -1), (1, edge), (-1, edge))]
    )
    border = seen(rim * half)
    low, high = border.min(axis=0), border.max(axis=0)
    # at least some samples of the grid wide: it reaches a few dozen beyond, where a polynomial over one pixel explodes
    least = min(_LEAST_GRAINS * settings.wavelength_m / bench.pupil_diameter_m, _LEAST_SINE)
    centre, reach = (low + high) / 2, np.maximum((high - low) / 2 * _MARGIN, least)
    to_panel = fit_series(
        lambda s: _panel_of(settings, s),
        degree=_DEGREE,
        centre=(float(centre[0]), float(centre[1])),
        half=(float(reach[0]), float(reach[1])),
    )

    reference = fit_series(
        lambda s: turns_at(settings, to_panel.at(s)),
        degree=_REFERENCE_DEGREE,
        centre=to_panel.centre,
        half=to_panel.half,
    )
    node = np.cos(np.pi * (np.arange(7) + 0.5) / 7)
    slm = np.stack(np.meshgrid(node * half[0], node * half[1]), axis=-1).reshape(-1, 2)
    return Sight(
        to_sight,
        to_panel,
        reference,
        _pupil_fit(settings, slm),
        bench.pupil_diameter_m / 2,
        2 * np.pi / settings.wavelength_m,
    )


def sight_of(settings: HologramSettings, slm_m: Array) -> Array:
    """Return the direction sines (..., 2) along which the pupil's centre sees panel points (..., 2)."""
    tangents = central_rays(settings, slm_m).field_tan
    return np.asarray(tangents / np.sqrt(1 + np.sum(tangents**2, axis=-1, keepdims=True)))


def _panel_of(settings: HologramSettings, s: Array) -> Array:
    """Return the panel points (n, 2) seen along s (n, 2), by tracing."""
    tangents = s / np.sqrt(1 - np.sum(s**2, axis=-1, keepdims=True))
    rays = trace_points(settings.bench, VirtualPoints.at(tangents), np.zeros(2), settings.gaze_rad)
    return rays.landing_m


def _pupil_fit(settings: HologramSettings, slm_m: Array) -> Array:
    """Return the coefficients of q(u), from how the path's phase varies with s at each pupil point."""
    radius, k = settings.bench.pupil_diameter_m / 2, 2 * np.pi / settings.wavelength_m
    pupil = pupil_grid(2.2 * radius, 15)
    there = connect(settings.bench, slm_m[:, None], pupil, gaze_rad=settings.gaze_rad)
    here = connect(settings.bench, slm_m, np.zeros(2), gaze_rad=settings.gaze_rad)
    s = sight_of(settings, slm_m)
    phase = -k * (there.path_m - here.path_m[:, None])
    plane = np.concatenate([s, np.ones((len(s), 1))], axis=1)
    u = np.linalg.lstsq(plane, phase, rcond=None)[0][:2].T
    coefficients = np.linalg.lstsq(_pupil_basis(u / (k * radius)), pupil / radius, rcond=None)[0]
    return np.asarray(coefficients)


def _pupil_basis(unit: Array) -> Array:
    return np.stack([unit[..., 0] ** i * unit[..., 1] ** j for i, j in _PUPIL_TERMS], axis=-1)
