"""Sampled grids over the panel: as fine as the light on them needs, not finer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
import torch

from holocal.hologram.zones import ZonePlan
from holocal.optics.bench import Array, Panel


@dataclass(frozen=True)
class Grid:
    """`columns` x `rows` samples over the same rectangle as the panel, centred, steps `step_x_m`, `step_y_m`."""

    columns: int
    rows: int
    step_x_m: float
    step_y_m: float

    @property
    def x_m(self) -> Array:
        """Sample centres, ascending, (columns,)."""
        return np.asarray((np.arange(self.columns) - (self.columns - 1) / 2) * self.step_x_m, np.float64)

    @property
    def y_m(self) -> Array:
        """Sample centres, descending, (rows,)."""
        return np.asarray(((self.rows - 1) / 2 - np.arange(self.rows)) * self.step_y_m, np.float64)


def panel_grid(panel: Panel) -> Grid:
    """Return the panel's own pixels as a grid."""
    return Grid(panel.width, panel.height, panel.pitch_m, panel.pitch_m)


def synthesis_grid(plan: ZonePlan, panel: Panel) -> Grid:
    """Return the coarsest FFT-friendly grid over the panel on which no zone's light aliases into the signal window.

    Divided by the reference, light of frequency f comes out at f - 1/step at worst: the step must keep
    |f| + (window's half width) below 1/step. Never finer than the panel.
    """
    counts = []
    for axis, pixels in ((0, panel.width), (1, panel.height)):
        inside = plan.window.half_size_per_m[axis]
        band = max((zone.band_per_m[axis] for zone in plan.zones), default=0.0)
        needed = 1.02 * (max(band, inside) + inside) * pixels * panel.pitch_m
        counts.append(min(pixels, int(scipy.fft.next_fast_len(int(np.ceil(needed)) + 16))))
    columns, rows = counts
    return Grid(columns, rows, panel.width * panel.pitch_m / columns, panel.height * panel.pitch_m / rows)


def resample_compact(compact: torch.Tensor, reach: tuple[int, int], source: Grid, target: Grid) -> torch.Tensor:
    """Return the compact spectrum (encode.fourier) that a field sampled on `source` has on `target`, in place.

    Both cover the same rectangle, so their frequencies are the same; the samples start half a step from its edge, and
    orthonormal spectra scale with the root of the number of samples. `reach` is the largest index (rows, columns).
    """
    lines = []
    for k, here, there in (
        (reach[0], source.rows, target.rows),
        (reach[1], source.columns, target.columns),
    ):
        index = np.r_[0 : k + 1, -k:0]
        first = 0.5 / there - 0.5 / here  # first sample, in widths of the rectangle
        lines.append(np.exp(2j * np.pi * index * first) * np.sqrt(there / here))
    rows, columns = (torch.from_numpy(line.astype(np.complex64)).to(compact.device) for line in lines)
    return compact.mul_(rows[:, None]).mul_(columns)
