"""Where the nominal hologram's light arrives on a built bench: one exact trace from the panel to the pupil."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from holocal.hologram.footprint import transmission
from holocal.optics.bench import Array, Bench
from holocal.optics.raytrace import trace_to_pupil
from holocal.tolerance.design import PANEL, Design, SentLight

AT_ONCE = 48  # directions, whose arrays stay in the cache


@dataclass(frozen=True)
class Arrival:
    """Light of D directions from N points of the panel on a built bench.

    Parameters
    ----------
    seen_tan
        (D, 2) tangents that each direction is seen along: the mean of its rays, each as bright as it is.
    wavefront_rad
        (D, N) delay at the pupil against a plane wave along the mean of the rays' directions, each as wide as its part
        of the pupil; piston and a small tilt are left in it.
    amount
        (D, N) part of the pupil's area that each point lights, as a share of it.
    lit
        (D,) their sum: how much of the pupil is lit.
    power
        (D,) power that passes the pupil, in the unit of `SentLight.power`.
    """

    seen_tan: Array
    wavefront_rad: Array
    amount: Array
    lit: Array
    power: Array


def arrival(design: Design, built: Bench, light: SentLight) -> Arrival:
    """Return where the light arrives; a direction of which none does has `lit` 0 and is seen where it was sent."""
    rows = np.flatnonzero(light.sent.any(axis=1))  # a small panel sends nothing in most directions of the margin
    parts = [_arrival(design, built, light.some(rows[k : k + AT_ONCE])) for k in range(0, len(rows), AT_ONCE)]
    count = light.sent.shape
    made = Arrival(light.field_tan.copy(), np.zeros(count), np.zeros(count), np.zeros(count[0]), np.zeros(count[0]))
    for k, part in enumerate(parts):
        at = rows[k * AT_ONCE : (k + 1) * AT_ONCE]
        made.seen_tan[at], made.wavefront_rad[at], made.amount[at], made.lit[at], made.power[at] = part
    return made


def _arrival(design: Design, built: Bench, light: SentLight) -> tuple[Array, Array, Array, Array, Array]:
    """Return the arrays of `Arrival` for some directions."""
    rays = trace_to_pupil(built, light.slm_m, light.direction)
    at = np.where(rays.valid[..., None], rays.landing_m, 1.0)
    through = np.where(rays.valid, transmission(at, design.pupil_diameter_m), 0.0)
    amount = (through * light.sent) ** 2 * _area(at) / (np.pi * (design.pupil_diameter_m / 2) ** 2)
    power = light.power * through**2
    toward = -rays.direction[..., :2]
    k = 2 * np.pi / design.wavelength_m
    plane = np.sum(_mean(toward, amount)[:, None] * at, axis=-1)
    wavefront = light.phase_rad + k * (rays.to_mirror_m + rays.from_mirror_m + plane)
    wavefront = np.where(amount > 0, wavefront - _mean(wavefront[..., None], amount), 0.0)
    sines = _mean(toward, power)
    lit = amount.sum(axis=1)
    seen = np.where((lit > 0)[:, None], sines / np.sqrt(1 - np.sum(sines**2, axis=-1, keepdims=True)), light.field_tan)
    return seen, wavefront, amount, lit, power.sum(axis=1)


def _mean(values: Array, weight: Array) -> Array:
    """Return the weighted means (D, k) of values (D, N, k); 0 where nothing weighs."""
    total = np.maximum(weight.sum(axis=1), 1e-300)
    return np.asarray(np.einsum("dnk,dn->dk", values, weight / total[:, None]))


def _area(at: Array) -> Array:
    """Return the area of the pupil's plane, (D, N) square metres, that each point of the panel's grid stands for."""
    grid = at.reshape(len(at), PANEL[1], PANEL[0], 2)
    down, along = np.gradient(grid, axis=1), np.gradient(grid, axis=2)
    area = down[..., 0] * along[..., 1] - down[..., 1] * along[..., 0]
    return np.asarray(np.abs(area).reshape(at.shape[:-1]))


def without_plane(values: Array, at_m: Array, weight: Array) -> Array:
    """Return values (..., D, N) less their best piston and tilt over points (D, N, 2), weighted (D, N)."""
    x = np.concatenate([np.ones((*weight.shape, 1)), 1e3 * at_m], axis=-1)
    weighted = x * weight[..., None]
    normal = np.einsum("dni,dnj->dij", weighted, x)
    normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    right = np.einsum("...dn,dni->...di", values, weighted)
    found = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(values - np.einsum("dni,...di->...dn", x, found))
