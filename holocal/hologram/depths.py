"""Points sorted by depth: those whose wavefronts differ by less than the wanted accuracy share a plan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import HologramSettings
from holocal.hologram.warp import Depth
from holocal.hologram.warped import accuracy_of
from holocal.optics.bench import Array

_SHARE = 0.4  # of the accuracy goes to sharing a depth, rms over evenly spread depths


def depth_bins(cloud: PointCloud, settings: HologramSettings) -> list[tuple[Depth, NDArray[np.intp]]]:
    """Return depths, far to near, with the indices of the points that are shown at each.

    A distance that is wrong by dkappa dioptres leaves k R^2 dkappa / (4 sqrt 3) rad rms over a pupil of radius R.
    Points on a sphere or on a plane across the gaze share one depth exactly; others share the middle of a bin.
    """
    if not len(cloud):
        return []
    sphere = 1.0 / cloud.distance_m
    plane = sphere * np.sqrt(1 + np.sum(cloud.field_tan**2, axis=-1))
    flat = bool(np.ptp(plane) < np.ptp(sphere))
    inverse = plane if flat else sphere
    radius = settings.bench.pupil_diameter_m / 2
    rad_per_dioptre = 2 * np.pi / settings.wavelength_m * radius**2 / (4 * np.sqrt(3))
    width = np.sqrt(12) * _SHARE * accuracy_of(settings) / rad_per_dioptre
    return [(Depth(middle, flat), index) for middle, index in _bins(inverse, width)]


def _bins(values: Array, width: float) -> list[tuple[float, NDArray[np.intp]]]:
    """Return (middle, indices) of groups of values that span at most `width`; equal values are met exactly."""
    if np.ptp(values) <= width:
        return [(_middle(values), np.arange(len(values)))]
    order = np.argsort(values, kind="stable")
    ordered, first, found = values[order], 0, []
    while first < len(ordered):
        last = int(np.searchsorted(ordered, ordered[first] + width, side="right"))
        found.append((_middle(ordered[first:last]), np.sort(order[first:last])))
        first = last
    return found


def _middle(values: Array) -> float:
    low, high = float(values.min()), float(values.max())
    middle = (low + high) / 2
    return float(np.format_float_positional(middle, precision=12, fractional=False)) if high - low < 1e-9 else middle
