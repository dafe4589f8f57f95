"""The rays that a pattern of spots sends from the panel, and where the eye sees them on any bench.

A spot's phase has one slope at every place of the panel, so one ray leaves there, whatever the bench: tracing it to the
pupil tells where a misaligned bench sends it. The middle of a spot's light in the picture is the mean of its rays'
directions, each as bright as its light, aberrations and diffraction included: that holds for waves too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array, Bench
from holocal.optics.raytrace import trace_to_pupil

FAINTEST = 1e-6  # of a spot's brightest ray: fainter ones are left out


@dataclass(frozen=True)
class PanelRays:
    """Rays of spots, one spot after the other.

    `slm_m` (n, 2) and `direction_s` (n, 3) in S; `light` (n,) what each carries; `first` (spots,) where a spot's begin.
    """

    slm_m: Array
    direction_s: Array
    light: Array
    first: NDArray[np.int64]


@dataclass(frozen=True)
class Landed:
    """Rays at the pupil's plane: `pupil_m` (n, 2) and `field_tan` (n, 2), the tangents in P that the eye sees them
    along; `arrived` (n,)."""

    pupil_m: Array
    field_tan: Array
    arrived: NDArray[np.bool_]


def panel_rays(slm_m: Array, slope_turns_per_m: Array, light: Array, wavelength_m: float) -> PanelRays:
    """Return the rays of spots with light (n, spots) at places (n, 2), from their phases' slopes (n, spots, 2).

    Places without light of a spot send no ray of it; every spot keeps at least one, dark as it may be.
    """
    brightest = np.maximum(light.max(axis=0), 1e-300)
    kept = (light > FAINTEST * brightest).T.copy()
    kept[~kept.any(axis=1), 0] = True
    spot, place = np.nonzero(kept)
    sines = wavelength_m * slope_turns_per_m[place, spot]
    along = np.sqrt(np.maximum(1 - np.sum(sines**2, axis=1), 0.0))
    first = np.searchsorted(spot, np.arange(light.shape[1]))
    return PanelRays(slm_m[place], np.column_stack([sines, along]), light[place, spot], first)


def landed(bench: Bench, rays: PanelRays) -> Landed:
    """Return where rays cross the plane of a bench's pupil."""
    traced = trace_to_pupil(bench, rays.slm_m, rays.direction_s)
    arrived = traced.valid & (traced.direction[:, 2] < 0)
    along = np.where(arrived, traced.direction[:, 2], -1.0)
    return Landed(traced.landing_m, traced.direction[:, :2] / along[:, None], arrived)


def middles(at: Landed, light: Array, first: NDArray[np.int64]) -> Array:
    """Return the middles of the spots' light, (spots, 2) tangents; NaN where no light of a spot arrives."""
    light = np.where(at.arrived, light, 0.0)
    sums = np.add.reduceat(np.column_stack([light, light[:, None] * at.field_tan]), first, axis=0)
    return np.asarray(sums[:, 1:] / np.where(sums[:, :1] > 0, sums[:, :1], np.nan))
