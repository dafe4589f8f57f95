"""Phase functions of a patch of the panel as a bilinear form in warped coordinates (docs/physics.md 4).

    phi_p(x) - psi0(x) = a(s) + b(p) + u(p) . g(s),        s = s(x)

with psi0 the reference, g a smooth warp of the sight coordinates, close to s itself, and u the place in the pupil. A
thesis zone shares one wavefront up to tilt, g = x, and leaves 1.55 rad rms in 5 x 5 zones; the warp lets the wavefront
change over the field and leaves 0.03.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from holocal.hologram.phase_model import wanted_phase
from holocal.hologram.settings import HologramSettings
from holocal.hologram.sight import Sight
from holocal.optics.bench import Array
from holocal.optics.phase_function import VirtualPoints
from holocal.optics.series import Series, chebyshev_products, fit_series

FIELD_NODES, PANEL_NODES = 9, 13
PANEL_DEGREE = 5  # total, of a and g: degree 4 leaves twice the error
MOST_ROUNDS, SETTLED = 400, 3e-3  # alternating least squares from g = s ends when a round gains less than this share
RIM = 0.05  # width of the soft edge of the weights, of the pupil's radius
OUTSIDE = 1e-9  # weight of rays that miss the pupil: they only keep the fit from running wild
Bounds = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Depth:
    """Where points lie: on a sphere about the pupil's centre, or on a plane across the gaze (`flat`).

    `inverse_m` is the inverse of its distance along the gaze, 1 / m (dioptres); 0 is infinitely far.
    """

    inverse_m: float
    flat: bool = False

    def points(self, field_tan: Array) -> VirtualPoints:
        """Return the virtual points at tangents (..., 2)."""
        if self.inverse_m == 0:
            return VirtualPoints.at(field_tan)
        distance = 1 / self.inverse_m * np.ones(field_tan.shape[:-1])
        if self.flat:
            distance = distance * np.sqrt(1 + np.sum(field_tan**2, axis=-1))
        return VirtualPoints.at(field_tan, distance)


@dataclass(frozen=True)
class Box:
    """A rectangle of sight coordinates: `centre` and `half`, (2,)."""

    centre: Array
    half: Array

    def basis(self, s: Array) -> Array:
        """Return Chebyshev products of total degree up to `PANEL_DEGREE` at points (k, 2), (k, terms)."""
        local = (s - self.centre) / self.half
        return chebyshev_products(local[:, 0], local[:, 1], PANEL_DEGREE)

    def series(self, coefficients: Array) -> Series:
        """Return the polynomial with these coefficients (terms, ...) as a series over the box."""
        return fit_series(
            lambda at: self.basis(at) @ coefficients,
            degree=PANEL_DEGREE,
            centre=(float(self.centre[0]), float(self.centre[1])),
            half=(float(self.half[0]), float(self.half[1])),
        )


@dataclass(frozen=True)
class Warp:
    """The bilinear form of a patch of the panel and the field that it shows.

    Parameters
    ----------
    phase_rad
        a(s), over the patch.
    coordinate
        g(s) with two values, over the patch.
    field
        Over the field's part, three values: u (radians per unit of g) and b (radians).
    square_rad2, weight
        Weighted sum of squares of what the form leaves of the phase, over rays through the pupil, and of the weights.
    """

    phase_rad: Series
    coordinate: Series
    field: Series
    square_rad2: float
    weight: float


def fit_warp(settings: HologramSettings, sight: Sight, depth: Depth, bounds: Bounds, box: Box) -> Warp:
    """Return the bilinear form of a patch of the panel and a part of the field.

    Alternating least squares over traced pairs (point, panel point). `bounds` are the tangents ((x low, x high),
    (y low, y high)) of the field's part.
    """
    centre = (sum(bounds[0]) / 2, sum(bounds[1]) / 2)
    half = ((bounds[0][1] - bounds[0][0]) / 2, (bounds[1][1] - bounds[1][0]) / 2)
    t = np.linspace(-1, 1, PANEL_NODES)
    s = np.stack(np.meshgrid(t * box.half[0], t * box.half[1]), axis=-1).reshape(-1, 2) + box.centre
    node = np.cos(np.pi * (np.arange(FIELD_NODES) + 0.5) / FIELD_NODES)
    tangents = np.stack(np.meshgrid(centre[0] + node * half[0], centre[1] + node * half[1]), axis=-1).reshape(-1, 2)
    phase, weight = _phases(settings, sight, depth.points(tangents[:, None]), s)
    piston = float(phase.mean())
    phase = phase - piston
    basis = box.basis(s)
    g = s - box.centre
    scale = float(np.abs(g).max())
    square = np.inf
    ub = _field_step(phase, weight, g / scale)
    for _ in range(MOST_ROUNDS):
        coefficients = _panel_step(phase - ub[:, 2:], weight, ub[:, :2], basis)
        a, g = basis @ coefficients[:, 0], scale * (basis @ coefficients[:, 1:])
        ub = _field_step(phase - a, weight, g / scale)
        rest = phase - a - ub[:, 2:] - (ub[:, :2] / scale) @ g.T
        before, square = square, float(np.sum(weight * rest**2))
        if square > (1 - SETTLED) ** 2 * before:
            break
    values = np.concatenate([ub[:, :2] / scale, ub[:, 2:] + piston], axis=1)
    field = fit_series(lambda _: values, degree=FIELD_NODES - 1, centre=centre, half=half)
    return Warp(
        box.series(coefficients[:, 0]),
        box.series(coefficients[:, 1:] * scale),
        field,
        square,
        float(np.sum(weight)),
    )


def _phases(settings: HologramSettings, sight: Sight, points: VirtualPoints, s: Array) -> tuple[Array, Array]:
    """Return phases (points, s) less the reference's, and weights by where the rays cross the pupil."""
    slm = sight.panel(s)
    found = wanted_phase(settings, points, slm, steps=5)
    radius = np.linalg.norm(found.pupil_m, axis=-1) / sight.pupil_radius_m
    weight = OUTSIDE + 1 / (1 + np.exp(np.clip((radius - 1) / RIM, -50, 50)))
    return found.phase_rad - sight.reference_rad(s), weight


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
