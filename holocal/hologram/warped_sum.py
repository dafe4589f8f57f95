"""The sum over points by the warped engine: one non-uniform transform per patch, one mask, one transform to the panel.

    points --type 3, per patch--> sight grid --FFT, pupil's mask--> spectrum --type 2--> the panel's pixels

Sorting points and samples takes as long as summing them: what depends only on where they are (`PatchSums`,
`ToPanel`) is made once and kept for the next scene with the same points, whatever their brightness and phase.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import finufft
import numpy as np
import scipy.fft
import torch
from numpy.typing import NDArray

from holocal.hologram.encode.blocks import in_blocks
from holocal.hologram.scenes.points import Aperture
from holocal.hologram.settings import HologramSettings
from holocal.hologram.warped import Layout, Patch, PatchForm, WarpedPlan, accuracy_of, inside_outline, pupil_mask
from holocal.optics.bench import Array, Panel

Complex = NDArray[np.complex64]
Floats = NDArray[np.float32]
_PLANNING = threading.Lock()  # FFTs may be planned by one thread at a time only
_BLOCK = 128  # rows at a time: float64 work that stays in the cache


def tolerance_of(settings: HologramSettings) -> float:
    """Return the relative accuracy of the transforms: asked for a tenth, they are twice as good as that."""
    return float(np.clip(accuracy_of(settings) / 10, 1e-5, 1e-2))


def _options(threads: int) -> dict[str, float]:
    # Fine grids 1.25 times oversampled are 3 times faster than 2 times. Points and samples come in rows, near enough
    # to sorted: sorting them costs more memory than it saves time.
    return {"upsampfac": 1.25, "spread_sort": 0, "nthreads": threads}


@dataclass
class PatchSum:
    """One patch's transform, made for certain points: which of them it shows, and the phases at both ends."""

    patch: Patch
    index: NDArray[np.intp]
    point_phasor: Complex
    factor: Complex
    plan: finufft.Plan
    keep: tuple[Floats, ...]

    def write_to(self, total: Complex, strengths: Complex) -> None:
        """Write the patch's sum over its points to its part of the grid."""
        chosen = strengths[self.index]
        chosen *= self.point_phasor
        part = total[self.patch.rows, self.patch.columns]
        np.multiply(self.plan.execute(chosen).reshape(part.shape), self.factor, out=part)


@dataclass
class PatchSums:
    """The transforms of all patches that show any of certain points; `dark` patches show none."""

    plan: WarpedPlan
    sums: list[PatchSum]
    dark: int

    def on_grid(self, strengths: Complex) -> Complex:
        """Return the hologram divided by the reference on the sight grid, for the points' complex amplitudes (n,)."""
        grid = self.plan.layout.grid
        total = np.zeros((grid.rows, grid.columns), np.complex64)

        # A patch per thread, from gathering its points to its last product: a quarter faster than two threads in each
        # transform, which work one after the other in all that is not the transform.
        def write(part: slice) -> None:
            for one in self.sums[part]:
                one.write_to(total, strengths)

        in_blocks(write, len(self.sums), 1)
        return total


def patch_sums(plan: WarpedPlan, field_tan: Array, *, tolerance: float) -> PatchSums:
    """Return the transforms of a plan for points at tangents (n, 2); `tolerance` is their relative accuracy."""
    found: list[PatchSum | None] = [None] * len(plan.forms)

    def make(part: slice) -> None:
        for i in range(part.start, part.stop):
            index = np.flatnonzero(inside_outline(field_tan, plan.forms[i].seen))
            if index.size:
                found[i] = _patch_sum(plan.layout, plan.forms[i], index, field_tan[index], tolerance)

    in_blocks(make, len(found), 1)
    sums = [one for one in found if one is not None]
    return PatchSums(plan, sums, len(plan.layout.patches) - len(sums))


def _patch_sum(
    layout: Layout, form: PatchForm, index: NDArray[np.intp], field_tan: Array, tolerance: float
) -> PatchSum:
    patch, warp = form.patch, form.warp
    s_x, s_y = layout.grid.s_x[patch.columns], layout.grid.s_y[patch.rows]
    ub = warp.field.at(field_tan)
    sources = tuple(np.ascontiguousarray(ub[:, axis], np.float32) for axis in (0, 1))
    coordinate = warp.coordinate.on_grid(s_x, s_y).astype(np.float32)
    targets = tuple(np.ascontiguousarray(coordinate[..., axis]).ravel() for axis in (0, 1))
    factor = phasor(warp.phase_rad.on_grid(s_x, s_y))
    with _PLANNING:
        plan = finufft.Plan(3, 2, 1, tolerance, 1, dtype="complex64", **_options(1))
        plan.setpts(*sources, None, *targets)
    return PatchSum(patch, index, phasor(ub[:, 2]), factor, plan, (*sources, *targets))


def phasor(phase_rad: Array) -> Complex:
    """Return exp(i phase), complex64, the phase reduced in double precision."""
    turns = phase_rad * (0.5 / np.pi)
    turns -= np.round(turns)
    reduced = (turns * (2 * np.pi)).astype(np.float32)
    out = np.empty(reduced.shape, np.complex64)
    np.cos(reduced, out=out.real)
    np.sin(reduced, out=out.imag)
    return out


@dataclass
class ToPanel:
    """From the sight grid to the panel's pixels: only light inside the pupil's mask is carried over.

    `rows`, `columns` index the frequencies kept, in the order -k..k.
    """

    layout: Layout
    panel: Panel
    plan: finufft.Plan
    keep: tuple[Floats, ...]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    def mask(self, diameter_m: float, aperture: Aperture | None) -> Complex:
        """Return the pupil's mask of the kept frequencies, scaled for `spectrum`."""
        grid = self.layout.grid
        whole = pupil_mask(self.layout, diameter_m, aperture)
        return np.asarray(whole[np.ix_(self.rows, self.columns)] / np.float32(grid.rows * grid.columns))

    def spectrum(self, field: Complex, mask: Complex) -> Complex:
        """Return the masked spectrum of a field on the grid, which is overwritten."""
        along = scipy.fft.fft(field, axis=1, workers=2, overwrite_x=True)
        tall = scipy.fft.fft(along[:, self.columns], axis=0, workers=2, overwrite_x=True)
        kept = tall[self.rows]
        kept *= mask
        return np.asarray(kept)

    def pixels(self, spectrum: Complex) -> Complex:
        """Return the field on the panel (height, width) of a masked spectrum."""
        out = self.plan.execute(spectrum)
        return np.asarray(out, np.complex64).reshape(self.panel.height, self.panel.width)


def to_panel(layout: Layout, panel: Panel, *, tolerance: float) -> ToPanel:
    """Return the transform from a layout's grid to the panel."""
    grid = layout.grid
    u_x, u_y = grid.frequencies()
    # the mask's edge, diffracted on the way to the panel, reaches a little beyond the pupil
    reach = 1.25 * layout.sight.pupil_radius_m * layout.sight.wavenumber
    columns, rows = _modes(u_x, reach), _modes(u_y, reach)
    place = np.empty((2, panel.height, panel.width), np.float32)
    for top in range(0, panel.height, _BLOCK):
        s = layout.sight.to_sight.on_grid(panel.x_m, panel.y_m[top : top + _BLOCK])
        # sample j of the grid is at phase 2 pi j / n of mode 1; rows run down
        down = (grid.first[1] - s[..., 1]) / (grid.step[1] * grid.rows)
        across = (s[..., 0] - grid.first[0]) / (grid.step[0] * grid.columns)
        for part, turns in zip(place[:, top : top + _BLOCK], (down, across), strict=True):
            part[:] = (turns - np.round(turns)) * (2 * np.pi)
    targets = (place[0].ravel(), place[1].ravel())
    plan = finufft.Plan(
        2, (len(rows), len(columns)), 1, tolerance, 1, dtype="complex64", **_options(torch.get_num_threads())
    )
    plan.setpts(*targets)
    return ToPanel(layout, panel, plan, targets, rows, columns)


def _modes(u: Array, reach: float) -> NDArray[np.intp]:
    """Return the indices of the discrete frequencies up to `reach`, in the order -k..k."""
    count = len(u)
    k = min(int(np.ceil(reach / abs(u[1]))), (count - 1) // 2) if count > 1 else 0
    return np.arange(-k, k + 1) % count
