"""Phase functions of a patch of the panel as a bilinear form in warped coordinates (docs/physics.md 4).

    phi_p(x) = a(x) + b(p) + u(p) . g(x)

with g a smooth warp of the panel, close to x itself, and u the tilt. A thesis zone shares one wavefront up to tilt,
g = x, and leaves 1.55 rad rms in 5 x 5 zones; the warp lets the wavefront change over the field and leaves 0.03.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from holocal.hologram.series import Series, fit_series
from holocal.hologram.settings import HologramSettings
from holocal.optics.bench import Array
from holocal.optics.phase_function import VirtualPoints, exact_phase, pupil_rim
from holocal.optics.raytrace import connect

FIELD_NODES, PANEL_NODES = 9, 13
PANEL_DEGREE = 5  # total, of a and g: degree 4 leaves twice the error
MOST_ROUNDS, SETTLED = 400, 3e-3  # alternating least squares from g = x ends when a round gains less than this share
RIM = 0.05  # width of the soft edge of the weights, of the pupil's radius
OUTSIDE = 1e-9  # weight of rays that miss the pupil: they only keep the fit from running wild


@dataclass(frozen=True)
class Box:
    """A rectangle of the panel: `centre` and `half`, (2,) metres."""

    centre: Array
    half: Array

    def basis(self, slm_m: Array) -> Array:
        """Return Chebyshev products of total degree up to `PANEL_DEGREE` at panel points, (k, terms)."""
        local = (slm_m - self.centre) / self.half
        in_x, in_y = (chebyshev.chebvander(local[:, axis], PANEL_DEGREE) for axis in (0, 1))
        pairs = [(i, j) for i in range(PANEL_DEGREE + 1) for j in range(PANEL_DEGREE + 1 - i)]
        return np.stack([in_x[:, i] * in_y[:, j] for i, j in pairs], axis=-1)


@dataclass(frozen=True)
class Warp:
    """The bilinear form of a part of the panel and a part of the field.

    Parameters
    ----------
    phase_rad
        a(x), over the panel.
    coordinate_m
        g(x) with two values, metres, over the panel.
    field
        Over the field's part, three values: u (radians per metre) and b (radians).
    residual_rad
        Rms of what the form leaves of the phase, over rays through the pupil from the panel.
    """

    phase_rad: Series
    coordinate_m: Series
    field: Series
    residual_rad: float


def fit_warp(
    settings: HologramSettings,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    outline_m: Array,
    pivot_m: Array,
) -> Warp:
    """Return the bilinear form of a part of the panel and a part of the field.

    Alternating least squares over traced pairs (point, panel point). `bounds` are the tangents ((x low, x high),
    (y low, y high)), `outline_m` (n, 2) corners of the panel's part.
    """
    centre = (sum(bounds[0]) / 2, sum(bounds[1]) / 2)
    half = ((bounds[0][1] - bounds[0][0]) / 2, (bounds[1][1] - bounds[1][0]) / 2)
    panel_half = settings.panel.half_size_m
    low = np.maximum(outline_m.min(axis=0), np.negative(panel_half))
    high = np.minimum(outline_m.max(axis=0), panel_half)
    t = np.linspace(-1, 1, PANEL_NODES)
    slm = np.stack(np.meshgrid(*((low[i] + high[i]) / 2 + t * (high[i] - low[i]) / 2 for i in (0, 1))), axis=-1)
    slm = slm.reshape(-1, 2)
    node = np.cos(np.pi * (np.arange(FIELD_NODES) + 0.5) / FIELD_NODES)
    tangents = np.stack(np.meshgrid(centre[0] + node * half[0], centre[1] + node * half[1]), axis=-1).reshape(-1, 2)
    phase, weight = _phases(settings, tangents, slm)
    piston = float(phase.mean())
    phase = phase - piston
    box = Box((low + high) / 2, (high - low) / 2)
    basis = box.basis(slm)
    g = slm - pivot_m
    scale = float(np.abs(g).max())
    residual = np.inf
    ub = _field_step(phase, weight, g / scale)
    for _ in range(MOST_ROUNDS):
        coefficients = _panel_step(phase - ub[:, 2:], weight, ub[:, :2], basis)
        a, g = basis @ coefficients[:, 0], scale * (basis @ coefficients[:, 1:])
        ub = _field_step(phase - a, weight, g / scale)
        rest = phase - a - ub[:, 2:] - (ub[:, :2] / scale) @ g.T
        before, residual = residual, float(np.sqrt(np.sum(weight * rest**2) / np.sum(weight)))
        if residual > (1 - SETTLED) * before:
            break
    values = np.concatenate([ub[:, :2] / scale, ub[:, 2:] + piston], axis=1)
    field = fit_series(lambda _: values, degree=FIELD_NODES - 1, centre=centre, half=half)
    coefficients[:, 1:] *= scale

    def over_panel(columns: slice) -> Series:  # the same polynomial, over the whole panel: exact at this degree
        return fit_series(
            lambda at: box.basis(at) @ coefficients[:, columns], degree=PANEL_DEGREE, centre=(0.0, 0.0), half=panel_half
        )

    phase_series = over_panel(slice(0, 1))
    phase_series = Series(phase_series.coefficients[..., 0], phase_series.centre, phase_series.half)
    return Warp(phase_series, over_panel(slice(1, 3)), field, residual)


def visible_field(settings: HologramSettings, outline_m: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the tangents (x low, high), (y low, high) of what a part of the panel shows through the pupil.

    With a margin of 15 % of the pupil, for a bench that is not quite where it should be.
    """
    rim = pupil_rim(settings.bench.pupil_diameter_m * 1.15, 32)
    seen = connect(settings.bench, outline_m[:, None], rim, gaze_rad=settings.gaze_rad).field_tan.reshape(-1, 2)
    nearer = 0.0 if np.isinf(settings.depth_m) else settings.bench.pupil_diameter_m / settings.depth_m
    low, high = seen.min(axis=0) - nearer, seen.max(axis=0) + nearer
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _phases(settings: HologramSettings, tangents: Array, slm_m: Array) -> tuple[Array, Array]:
    """Return exact phases (points, panel points), piston removed, and weights by where the rays cross the pupil."""
    found = exact_phase(
        settings.bench,
        VirtualPoints.at(tangents[:, None], settings.depth_m),
        slm_m,
        wavelength_m=settings.wavelength_m,
        gaze_rad=settings.gaze_rad,
        steps=5,
    )
    radius = np.linalg.norm(found.pupil_m, axis=-1) / (settings.bench.pupil_diameter_m / 2)
    weight = OUTSIDE + 1 / (1 + np.exp(np.clip((radius - 1) / RIM, -50, 50)))
    return found.phase_rad, weight


def _field_step(phase: Array, weight: Array, g: Array) -> Array:
    """Return u and b, (points, 3), that best explain phases (points, panel points) with g given (panel points, 2)."""
    plane = np.concatenate([g, np.ones((len(g), 1))], axis=1)
    normal = np.einsum("pk,ki,kj->pij", weight, plane, plane, optimize=True)
    right = np.einsum("pk,ki->pi", weight * phase, plane)
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _panel_step(phase: Array, weight: Array, u: Array, basis: Array) -> Array:
    """Return the coefficients (terms, 3) of a and g that best explain phases with u given (points, 2)."""
    factors = np.concatenate([np.ones((len(u), 1)), u / np.abs(u).max()], axis=1)
    moments = np.einsum("pk,pi,pj->kij", weight, factors, factors, optimize=True)
    terms = basis.shape[1]
    normal = np.einsum("kij,ks,kt->sitj", moments, basis, basis, optimize=True).reshape(3 * terms, 3 * terms)
    right = np.einsum("ki,ks->si", np.einsum("pk,pi->ki", weight * phase, factors), basis).ravel()
    solved = np.linalg.lstsq(normal, right, rcond=1e-14)[0].reshape(terms, 3)
    solved[:, 1:] /= np.abs(u).max()
    return np.asarray(solved)
