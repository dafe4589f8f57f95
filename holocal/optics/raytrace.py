"""Rays through the bench, both ways, and the path between a pupil point and a panel point.

Batched float64; every function takes (..., 3) or (..., 2) arrays and broadcasts their leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array, Bench

_WIDEST_TAN = 1e6  # a search that runs away stops here: 0.2 seconds of arc from a right angle


@dataclass(frozen=True)
class Rays:
    """Rays from the eye's side to the panel's plane, or back.

    `landing_m` (..., 2) is where they meet the target plane, in its own axes (S on the panel, P at the pupil);
    `to_mirror_m` and `from_mirror_m` (...) are the two path lengths; `direction` (..., 3) the unit direction of travel
    at the target, in the target's axes; `valid` (...) is False where a ray misses the mirror or the plane.
    """

    landing_m: Array
    to_mirror_m: Array
    from_mirror_m: Array
    direction: Array
    valid: NDArray[np.bool_]


def reflect(bench: Bench, origin: Array, direction: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return (path to the mirror, mirror point, reflected unit direction, valid) of rays from inside the ellipsoid.

    `origin` and `direction` are (..., 3) in E, directions of unit length. The far intersection is taken: from a point
    inside the ellipsoid there is exactly one ahead.
    """
    offset = origin - bench.mirror_centre
    q_direction, q_offset = direction @ bench.mirror_quadric, offset @ bench.mirror_quadric
    a = np.sum(direction * q_direction, axis=-1)
    b = np.sum(offset * q_direction, axis=-1)
    c = np.sum(offset * q_offset, axis=-1) - 1.0
    root = b * b - a * c
    valid = (root >= 0) & (c < 0)
    path = (-b + np.sqrt(np.maximum(root, 0.0))) / a
    mirror = origin + path[..., None] * direction
    normal = (mirror - bench.mirror_centre) @ bench.mirror_quadric
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    reflected = direction - 2 * np.sum(direction * normal, axis=-1, keepdims=True) * normal
    return path, mirror, reflected, valid


def _land(mirror: Array, direction: Array, centre: Array, axes: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return (path, landing (..., 2) in the plane's axes, valid) of rays from the mirror on a plane."""
    along = direction @ axes[:, 2]
    away = np.abs(along) < 1e-12
    path = ((centre - mirror) @ axes[:, 2]) / np.where(away, 1.0, along)
    landing = (mirror + path[..., None] * direction - centre) @ axes[:, :2]
    return path, landing, ~away & (path > 0)


def trace_to_slm(bench: Bench, origin: Array, direction: Array) -> Rays:
    """Trace from the eye's side to the panel's plane.

    Parameters
    ----------
    bench
        Nominal or misaligned.
    origin, direction
        (..., 3) points (metres) and unit directions in E, away from the eye.

    Returns
    -------
    Rays
        Landing on the panel's plane in S; the light itself travels the other way: it leaves the panel along
        ``-direction``.
    """
    to_mirror, mirror, reflected, hit = reflect(bench, origin, direction)
    from_mirror, landing, ahead = _land(mirror, reflected, bench.slm_centre, bench.slm_axes)
    return Rays(landing, to_mirror, from_mirror, reflected @ bench.slm_axes, hit & ahead)


def trace_to_pupil(bench: Bench, slm_m: Array, direction_s: Array, gaze_rad: tuple[float, float] = (0.0, 0.0)) -> Rays:
    """Trace from the panel to the pupil's plane: the way the light goes.

    `slm_m` (..., 2) metres and `direction_s` (..., 3) unit directions in S; the landing and the direction of travel
    come in P.
    """
    origin = bench.slm_centre + slm_m @ bench.slm_axes[:, :2].T
    to_mirror, mirror, reflected, hit = reflect(bench, origin, direction_s @ bench.slm_axes.T)
    axes = bench.pupil_axes(gaze_rad)
    from_mirror, landing, ahead = _land(mirror, reflected, axes[:, 2] * bench.eye_relief_m, axes)
    return Rays(landing, to_mirror, from_mirror, reflected @ axes, hit & ahead)


def newton_step(slope: Array, wanted: Array) -> Array:
    """Return the steps (..., 2) that change a landing by `wanted` (..., 2), for slopes (..., 2, 2).

    0 where the slope is singular or not finite: the search stays where it is, and its landing error says so.
    """
    determinant = slope[..., 0, 0] * slope[..., 1, 1] - slope[..., 0, 1] * slope[..., 1, 0]
    solvable = np.isfinite(determinant) & (np.abs(determinant) > 1e-300)
    safe = np.where(solvable[..., None, None], slope, np.eye(2))
    return np.asarray(np.where(solvable[..., None], np.linalg.solve(safe, wanted[..., None])[..., 0], 0.0))


def landing_error(rays: Rays, slm_m: Array) -> Array:
    """Return how far rays land from panel points (..., 2), metres; infinite where they miss the mirror or the plane."""
    error = np.linalg.norm(rays.landing_m - slm_m, axis=-1)
    return np.asarray(np.where(rays.valid & np.isfinite(error), error, np.inf))


@dataclass(frozen=True)
class Connection:
    """The ray between a pupil point and a panel point.

    `path_m` (...) is its whole length; `field_tan` (..., 2) the tangents, in P, of the direction it leaves the eye
    along; `slm_direction` (..., 3) the unit direction in S of the light leaving the panel; `mixed` (..., 2, 2) the
    derivative d(landing_i) / d(field_tan_j) at a fixed pupil point, metres.
    """

    path_m: Array
    field_tan: Array
    slm_direction: Array
    mixed: Array
    error_m: Array


def connect(
    bench: Bench,
    slm_m: Array,
    pupil_m: Array,
    *,
    gaze_rad: tuple[float, float] = (0.0, 0.0),
    steps: int = 7,
) -> Connection:
    """Find the ray between panel points (..., 2) in S and pupil points (..., 2) in P by Newton's method.

    Starts from the ideal image of the panel at the eye's rotation centre. `error_m` says how far from the panel point
    the ray lands: below 1e-12 m everywhere in the thesis's field, misaligned by degrees or not. It is infinite where
    the last ray misses the mirror or the panel's plane: no such ray was found.
    """
    slm_m, pupil_m = np.broadcast_arrays(np.asarray(slm_m, float), np.asarray(pupil_m, float))
    axes = bench.pupil_axes(gaze_rad)
    origin = bench.pupil_points(pupil_m, gaze_rad)
    tangents = (pupil_m + slm_m / bench.magnification) / bench.eye_relief_m

    def shoot(tan: Array) -> Rays:
        local = np.concatenate([tan, np.ones((*tan.shape[:-1], 1))], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return trace_to_slm(bench, origin, local @ axes.T)

    eps = 1e-6
    rays = shoot(tangents)
    mixed = np.empty((*slm_m.shape[:-1], 2, 2))
    for step in range(steps):
        if step < 4:  # the map is smooth: a Jacobian from near the solution serves the last steps
            for j in (0, 1):
                ahead, behind = tangents.copy(), tangents.copy()
                ahead[..., j] += eps
                behind[..., j] -= eps
                mixed[..., j] = (shoot(ahead).landing_m - shoot(behind).landing_m) / (2 * eps)
        tangents = np.clip(tangents + newton_step(mixed, slm_m - rays.landing_m), -_WIDEST_TAN, _WIDEST_TAN)
        rays = shoot(tangents)
    error = landing_error(rays, slm_m)
    return Connection(rays.to_mirror_m + rays.from_mirror_m, tangents, -rays.direction, mixed, error)
