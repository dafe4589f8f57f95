"""The wavefront of a spot's light from the directions of its rays: their slopes, fitted by Zernike polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array
from holocal.optics.panel_rays import Landed
from holocal.optics.zernike import zernike, zernike_gradient

NOLL = tuple(range(4, 16))  # a displaced mirror leaves 0.03 rad and less beyond the sixth
TILT = (2, 3)
FEWEST = len(NOLL) + len(TILT)  # rays of a spot whose wavefront is asked for: each has two slopes
FAINTEST = 1e-3  # of a spot's brightest ray


@dataclass(frozen=True)
class RayWavefronts:
    """Of every spot: `coefficients_rad` (spots, modes) of Zernike polynomials over the whole pupil; `metric` (spots,
    modes, modes): c @ metric @ c is the mean square over the spot's light, piston and tilt taken off. NaN for a spot of
    too few rays."""

    coefficients_rad: Array
    metric: Array

    @property
    def rms_rad(self) -> Array:
        """Return the rms over the light of every spot, (spots,)."""
        c = self.coefficients_rad
        return np.asarray(np.sqrt(np.maximum(np.einsum("si,sij,sj->s", c, self.metric, c), 0.0)))


def wavefronts(
    at: Landed,
    light: Array,
    first: NDArray[np.int64],
    *,
    radius_m: float,
    wavelength_m: float,
    noll: Sequence[int] = NOLL,
) -> RayWavefronts:
    """Return the spots' wavefronts over a pupil of a radius.

    A ray that the eye sees along the tangents t crosses the pupil where the wavefront slopes by k t: relative to the
    spot's middle that is its aberration.
    """
    k = 2 * np.pi / wavelength_m
    modes = (*TILT, *noll)
    sines = at.field_tan / np.sqrt(1 + np.sum(at.field_tan**2, axis=1, keepdims=True))
    place = at.pupil_m / radius_m
    light = np.where(at.arrived, light, 0.0)
    ends = [*first[1:], len(light)]
    coefficients = np.full((len(first), len(noll)), np.nan)
    metric = np.full((len(first), len(noll), len(noll)), np.nan)
    for spot, (start, end) in enumerate(zip(first, ends, strict=True)):
        own = np.flatnonzero(light[start:end] > FAINTEST * light[start:end].max(initial=0.0)) + start
        if len(own) < FEWEST:
            continue
        weight = light[own] / light[own].sum()
        x, y = place[own].T
        wanted = -k * (sines[own] - weight @ sines[own])
        root = np.sqrt(weight)
        design = (zernike_gradient(modes, x, y) / radius_m * root[:, None]).reshape(len(modes), -1).T
        coefficients[spot] = np.linalg.lstsq(design, (wanted * root[:, None]).ravel(), rcond=1e-6)[0][len(TILT) :]
        metric[spot] = _metric(zernike(noll, x, y).T, x, y, weight)
    return RayWavefronts(coefficients, metric)


def _metric(basis: Array, x: Array, y: Array, weight: Array) -> Array:
    """Return the Gram matrix of a basis (n, modes) over weighted places, piston and tilt taken off."""
    root = np.sqrt(weight)[:, None]
    plane = np.column_stack([np.ones_like(x), x, y]) * root
    left = basis * root - plane @ np.linalg.lstsq(plane, basis * root, rcond=None)[0]
    return np.asarray(left.T @ left)
