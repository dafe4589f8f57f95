"""Scenes of random points, for engines that are compared with each other or with a sum."""

from __future__ import annotations

import numpy as np

from holocal.hologram.scenes.points import Aperture, PointCloud
from holocal.hologram.settings import HologramSettings


def cloud(
    settings: HologramSettings,
    count: int,
    *,
    seed: int = 0,
    distance: float | np.ndarray = np.inf,
    aperture: Aperture | None = None,
) -> PointCloud:
    """Return points all over the settings' field, of amplitudes 0.2 to 1 and any phase."""
    rng = np.random.default_rng(seed)
    half = np.tan(np.asarray(settings.fov_rad) / 2)
    return PointCloud(
        rng.uniform(-1, 1, (count, 2)) * half,
        np.broadcast_to(np.asarray(distance, float), count).copy(),
        rng.uniform(0.2, 1, count),
        2 * np.pi * rng.random(count),
        aperture,
    )
