"""The full-complex hologram of a grid of points, zone by zone: each zone one non-uniform Fourier transform.

With the reference psi0 taken out, a zone c adds

    A_c(x) exp(i [phi_c(x) - psi0(x)]) sum_p a_p exp(i [tilt_p . (x - pivot_c) + piston_p])

and the sum, over points whose tilts lie anywhere, is a type-1 transform (FINUFFT) onto the pixels of the footprint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import finufft
import numpy as np
import torch
from numpy.typing import NDArray

from holocal.hologram.footprint import row_spans, soft_span
from holocal.hologram.grid import Grid
from holocal.hologram.scenes.image import PointGrid
from holocal.hologram.zones import Zone, ZonePlan

Complex = NDArray[np.complex64]

# Relative accuracy of the transforms; IFTA's own signal error is 100 times larger. At 1e-4 FINUFFT may use its small
# fine grid (1.25 instead of 2 times oversampled), which is 2.5 times faster here.
_ACCURACY = 1e-4
_OVERSAMPLING = 1.25


@dataclass(frozen=True)
class Box:
    """The rows and columns of a grid that a zone's footprint touches."""

    rows: slice
    columns: slice

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start


def synthesise(
    plan: ZonePlan, grid: Grid, scenes: Sequence[PointGrid], *, device: str = "cpu"
) -> tuple[torch.Tensor, list[str]]:
    """Return the holograms divided by the reference, (scenes, rows, columns) complex64, and what was left out.

    Parameters
    ----------
    plan
        The zones.
    grid
        Where to sample; `synthesis_grid` gives the coarsest that will do.
    scenes
        Points on one and the same grid of tangents: several images, or one with several initial phases. They share
        the zones' factors.

    Returns
    -------
    torch.Tensor, list of str
        Scaled so that a point of amplitude 1 has modulus 1 in its footprint; a sentence for each thing skipped.
    """
    total = torch.zeros((len(scenes), grid.rows, grid.columns), dtype=torch.complex64, device=device)
    skipped = plan.left_out()
    dark = 0
    for zone in plan.zones:
        rows, columns = _points_of(zone, plan, scenes[0])
        bright = np.any([scene.amplitude[rows, columns] > 0 for scene in scenes], axis=0)
        dark += int(not bright.any())
        box = _box(zone, grid) if bright.any() else None
        if box is None:
            continue
        waves = _zone_waves(zone, grid, box, scenes, (rows, columns), bright)
        factor = _zone_factor(zone, grid, box, device)
        total[:, box.rows, box.columns].addcmul_(torch.from_numpy(waves).to(device), factor)
    if dark:
        what = "patches of" if plan.warped else "zones on"
        skipped.append(f"{dark} of {len(plan.zones)} {what} the panel: dark in the image")
    return total, skipped


def _points_of(zone: Zone, plan: ZonePlan, scene: PointGrid) -> tuple[slice, slice]:
    """Return the rows and columns of the image whose points are the zone's; borders go to the right and upper zone."""
    if zone.warp is not None:
        chosen = [
            np.flatnonzero((tangent >= low) & (tangent <= high))
            for tangent, (low, high) in zip((scene.y_tan, scene.x_tan), zone.bounds[::-1], strict=True)
        ]
        rows_columns = [slice(int(c[0]), int(c[-1]) + 1) if c.size else slice(0, 0) for c in chosen]
        return rows_columns[0], rows_columns[1]
    count = len(plan.edges_x) - 1
    columns = np.clip(np.searchsorted(plan.edges_x, scene.x_tan, side="right") - 1, 0, count - 1)
    rows = count - 1 - np.clip(np.searchsorted(plan.edges_y, scene.y_tan, side="right") - 1, 0, count - 1)
    row, column = np.flatnonzero(rows == zone.row), np.flatnonzero(columns == zone.column)
    if not row.size or not column.size:
        return slice(0, 0), slice(0, 0)
    return slice(int(row[0]), int(row[-1]) + 1), slice(int(column[0]), int(column[-1]) + 1)


def _box(zone: Zone, grid: Grid) -> Box | None:
    """Return the part of the grid inside the footprint's bounding box, one pixel wider; None where there is none."""
    x, y = grid.x_m, grid.y_m
    (left, low), (right, high) = zone.rim_m.min(axis=0), zone.rim_m.max(axis=0)
    columns = np.flatnonzero((x > left - grid.step_x_m) & (x < right + grid.step_x_m))
    rows = np.flatnonzero((y > low - grid.step_y_m) & (y < high + grid.step_y_m))
    if not rows.size or not columns.size:
        return None
    return Box(slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))


def _zone_waves(
    zone: Zone, grid: Grid, box: Box, scenes: Sequence[PointGrid], part: tuple[slice, slice], bright: NDArray[np.bool_]
) -> Complex:
    """Return the zone's sums over its points, (scenes, rows, columns) complex64, by one type-1 transform."""
    rows, columns = part
    shift = zone.shift.on_grid(scenes[0].x_tan[columns], scenes[0].y_tan[rows])[bright]
    if zone.warp is not None:
        return _warped_waves(zone, grid, box, scenes, part, bright, shift)
    height, width = box.shape
    origin_x = grid.x_m[box.columns.start + width // 2]  # mode 0 of the transform
    origin_y = grid.y_m[box.rows.start + height // 2]
    turns = shift[:, 0] * (origin_x - zone.pivot_m[0]) + shift[:, 1] * (origin_y - zone.pivot_m[1]) + shift[:, 2]
    strengths = _strengths(turns, scenes, part, bright)
    per_row = (-2 * np.pi * grid.step_y_m * shift[:, 1]).astype(np.float32)  # rows run downwards
    per_column = (2 * np.pi * grid.step_x_m * shift[:, 0]).astype(np.float32)
    waves = finufft.nufft2d1(
        per_row, per_column, strengths, (height, width), eps=_ACCURACY, isign=1, upsampfac=_OVERSAMPLING
    )
    return np.asarray(waves, np.complex64).reshape(len(scenes), height, width)


def _strengths(
    turns: NDArray[np.float64], scenes: Sequence[PointGrid], part: tuple[slice, slice], bright: NDArray[np.bool_]
) -> Complex:
    """Return the bright points' amplitudes with their phases, `turns` added, (scenes, points) complex64."""
    rows, columns = part
    turns = turns - np.round(turns)
    strengths = np.empty((len(scenes), len(turns)), np.complex64)
    for strength, scene in zip(strengths, scenes, strict=True):
        phase = 2 * np.pi * turns + scene.phase_rad[rows, columns][bright]
        strength[:] = scene.amplitude[rows, columns][bright] * np.exp(1j * phase)
    return strengths


def _warped_waves(
    zone: Zone,
    grid: Grid,
    box: Box,
    scenes: Sequence[PointGrid],
    part: tuple[slice, slice],
    bright: NDArray[np.bool_],
    shift: NDArray[np.float64],
) -> Complex:
    """Return the zone's sums over its points in warped coordinates: a type-3 transform onto the footprint's samples."""
    assert zone.warp is not None
    x, y = grid.x_m[box.columns], grid.y_m[box.rows]
    warped = zone.warp.on_grid(x, y).astype(np.float32)
    tilt = (2 * np.pi * shift[:, :2]).astype(np.float32)
    waves = finufft.nufft2d3(
        np.ascontiguousarray(tilt[:, 0]),
        np.ascontiguousarray(tilt[:, 1]),
        _strengths(shift[:, 2], scenes, part, bright),
        np.ascontiguousarray(warped[..., 0]).ravel(),
        np.ascontiguousarray(warped[..., 1]).ravel(),
        eps=_ACCURACY,
        isign=1,
        upsampfac=_OVERSAMPLING,
    )
    return np.asarray(waves, np.complex64).reshape(len(scenes), *box.shape)


def _zone_factor(zone: Zone, grid: Grid, box: Box, device: str) -> torch.Tensor:
    """Return the footprint times exp(i [phi_c - psi0]), (rows, columns) complex64; phases reduced in float64."""
    x, y = grid.x_m[box.columns], grid.y_m[box.rows]
    in_y, in_x = zone.factor_turns.bases(x, y)
    turns = torch.from_numpy(in_y) @ torch.from_numpy(zone.factor_turns.coefficients @ in_x.T)
    turns -= torch.round(turns)
    mask = torch.from_numpy(soft_span(x, *row_spans(zone.rim_m, y), grid.step_x_m))
    return torch.polar(mask, turns.mul_(2 * np.pi).to(torch.float32)).to(device)
