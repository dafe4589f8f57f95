"""Free space: every distance against the Rayleigh-Sommerfeld sum, and the time at the panel's size."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import scipy.ndimage
import torch

from holocal.app.bench.measure import Unit
from holocal.optics.propagate import Propagator, propagate, rayleigh_sommerfeld_sum

Row = dict[str, Any]
PITCH_M, WAVELENGTH_M = 3.74e-6, 515e-9
DISTANCES_M = (1e-3, 5e-3, 13e-3, 15e-3, 50e-3, 200e-3, 1.0)
_FINER, _PIXELS, _JUDGED = 4, 256, 48


def errors() -> Iterator[Row]:
    """Yield a row per distance: relative L2 error in float32 of a soft-edged disc, 256 x 256, at random pixels.

    The sum runs over samples four times finer: where pixels alone would alias, it does not.
    """
    fine_pitch = PITCH_M / _FINER
    line = (np.arange(_PIXELS * _FINER) - (_PIXELS * _FINER - 1) / 2) * fine_pitch
    disc = (np.hypot(line, line[:, None]) < 0.25e-3).astype(np.float64)
    fine = scipy.ndimage.gaussian_filter(disc, 2 * _FINER, truncate=8)  # cut at 4 sigma it is not smooth to 1e-7
    middle = (np.arange(_PIXELS) - (_PIXELS - 1) / 2) * PITCH_M
    coarse = scipy.ndimage.map_coordinates(
        fine, np.meshgrid((middle - line[0]) / fine_pitch, (middle - line[0]) / fine_pitch, indexing="ij"), order=5
    )
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(64, 192, _JUDGED), rng.integers(64, 192, _JUDGED)
    lit = slice(int(np.flatnonzero(fine.any(axis=0))[0]), int(np.flatnonzero(fine.any(axis=0))[-1]) + 1)  # symmetric
    fine = fine[lit, lit]
    at = np.stack([middle[columns], -middle[rows]], axis=-1)
    for distance in DISTANCES_M:
        shared = {"pitch_m": PITCH_M, "wavelength_m": WAVELENGTH_M, "distance_m": distance}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = propagate(torch.from_numpy(coarse.astype(np.complex64)), **shared).numpy()[rows, columns]
        exact = rayleigh_sommerfeld_sum(
            torch.from_numpy(fine.astype(np.complex128)), at, **(shared | {"pitch_m": fine_pitch})
        ).numpy()
        error = float(np.linalg.norm(found - exact) / np.linalg.norm(exact))
        yield {"table": "propagation", "size": "256x256", "distance_m": distance, "relative_l2": error}


def times(width: int, height: int, *, runs: int) -> Iterator[Row]:
    """Yield a row per distance: a prepared propagation, padded to twice the size."""
    unit = Unit(height, width)
    phase = np.random.default_rng(1).uniform(-np.pi, np.pi, (height, width)).astype(np.float32)
    field = torch.polar(torch.ones(phase.shape), torch.from_numpy(phase))
    for distance in (5e-3, 200e-3):
        made = Propagator.prepare(
            field.shape, pitch_m=PITCH_M, wavelength_m=WAVELENGTH_M, distance_m=distance, like=field
        )
        timing = unit.ratio(partial(made.forward, field), runs=runs)
        yield {"table": "propagation", "size": f"{width}x{height}", "distance_m": distance} | timing.row()
