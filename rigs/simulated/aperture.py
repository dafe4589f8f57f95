"""The field in the pupil, from the levels on the panel: aperture synthesis, patch by patch.

    U(q) = pitch^2 / wavelength  sum_x  u(x) sqrt|det d2L/dx dq|  exp(i k L(x, q))           (unitary: power is kept)

1. Each patch of the panel gives its own small piece of the field, on a coarse grid of the pupil: a non-uniform Fourier
   transform in the patch's own warped coordinates (FINUFFT type 3), because a small patch cannot make fine detail.
2. The pieces of a line of patches, side by side, are brought to the pupil's fine columns by a polyphase filter, each on
   its own carrier, and added: one small matrix product per block of fine columns does all three (`resample`).
3. The lines are brought to the fine rows likewise. The result is the whole field on the fine grid.

The cost is a few operations per panel pixel and about twenty per pupil sample, instead of one per pair of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array, Bench, Panel
from rigs.simulated.kernel import Box, PatchKernel, PathTable, Polynomial, fit_patch
from rigs.simulated.pupil import Complex, PupilGrid, unit_phase
from rigs.simulated.resample import TAPS, Resampling, add_piece, transposed
from rigs.simulated.stencil import Factors, Stencil, apply, fit_stencil

NUFFT_EPS = 1e-3  # relative, each patch; the phase model's 0.002 rad is the larger error
PATCH_PX = (384, 360)  # patch in the panel's middle, columns and rows, for a phase error of 0.002 rad rms
PATCH_PUPIL_M = 4e-3  # wider pupils need smaller patches: a patch of 240 x 136 pixels leaves 0.003 rad at 9 mm
# The mirror is nearer to +x directions: there patches are narrower, else their errors are five times those at -x.
PATCH_SLOPE_PER_M = 60.0
# A line's pieces hold, beside the patch's own light, the bend of its wave against the middle patch's. Six patches: half
# the samples of a line of seventeen, and little more to add up.
LINE_PATCHES = 6


@dataclass(frozen=True)
class _Place:
    """A patch: its pixels, phase model, coarse columns, and the wave of the patch in the middle of its line."""

    rows: slice
    columns: slice
    kernel: PatchKernel
    across: Resampling
    stencil: Stencil
    reference: Polynomial


@dataclass(frozen=True)
class _Patch:
    plan: Any
    rows: slice
    columns: slice
    phase: Complex  # illumination, alpha and amplitude over the patch
    needed: NDArray[np.intp]  # which of the coarse points (columns, rows), flat
    to_pupil: NDArray[np.float32]  # the amplitude's other factor, at the coarse points
    first: Factors  # of the stencil, at the inner coarse points
    second: Factors
    carrier: Complex  # at the coarse points: what the fine carriers leave of the patch's wave


class PanelToPupil:
    """The linear map from the panel's pixels to the pupil, for one bench and one wavelength.

    The plans of the patches are made in the background; the first `field` waits for them.

    Parameters
    ----------
    bench
        The true, misaligned bench.
    panel
        The panel's pixels.
    wavelength_m
        Metres.
    illumination
        (height, width) amplitude of the light on the panel, without its tilt, or None for 1. Complex where the panel
        is not flat.
    fill_factor
        Share of a pixel's area that is modulated, or None for point-like pixels (no sinc envelope, no zero order).
    pupil_edge_m
        Width over which the pupil's transmission falls from 1 to 0, half way at its nominal rim.
    patch_px
        Patch in the panel's middle, columns and rows; None for one that the pupil's width allows.

    Attributes
    ----------
    grid
        The pupil's grid, and the mean wave that the field is stored without.
    residual
        Relative rms error of the field that the patches' form and its stencil leave, mean over patches.
    """

    def __init__(
        self,
        bench: Bench,
        panel: Panel,
        wavelength_m: float,
        *,
        illumination: NDArray[np.float32] | Complex | None = None,
        fill_factor: float | None = None,
        pupil_edge_m: float = 2e-4,
        patch_px: tuple[int, int] | None = None,
    ) -> None:
        self.panel, self.wavelength_m, self.fill_factor = panel, wavelength_m, fill_factor
        self._illumination = illumination
        self.radius_m = (bench.pupil_diameter_m + pupil_edge_m) / 2  # outside of it no light passes
        half_x, half_y = panel.half_size_m
        reach = self.radius_m * 1.005
        table = PathTable.trace(bench, Box(-half_x, half_x, -half_y, half_y), Box(-reach, reach, -reach, reach))
        self.grid = PupilGrid.of(table, self.radius_m, wavelength_m, pupil_edge_m)
        self.transmission = self.grid.transmission(bench.pupil_diameter_m / 2, pupil_edge_m)
        self._pool = ThreadPoolExecutor(max(1, torch.get_num_threads()))
        share = min(1.0, PATCH_PUPIL_M / bench.pupil_diameter_m)
        across, down = patch_px or (share * PATCH_PX[0], share * PATCH_PX[1])
        rows = _cuts(panel.y_m, np.full(panel.height, float(down)))
        columns = _cuts(panel.x_m, across * np.clip(1 - PATCH_SLOPE_PER_M * panel.x_m, 0.5, 1.5))
        cells = [[(r, c) for c in group] for r in rows for group in _groups(columns, LINE_PATCHES)]
        boxes = [self._box(*cell) for line in cells for cell in line]
        kernels = list(self._pool.map(lambda box: fit_patch(table, box, wavelength_m), boxes))
        fitted = iter(kernels)
        lines = self._plan_coarse_grids([[(*cell, next(fitted)) for cell in line] for line in cells])
        self._places = [place for line in lines for place in line]
        self.residual = float(np.mean([place.stencil.residual for place in self._places]))
        self._patches: list[Future[_Patch]] = [self._pool.submit(self._plan_patch, place) for place in self._places]
        self._plan_sums(lines)
        self._unmodulated: torch.Tensor | None = None

    def _box(self, rows: slice, columns: slice) -> Box:
        x, y, half = self.panel.x_m[columns], self.panel.y_m[rows], self.panel.pitch_m / 2
        return Box(x[0] - half, x[-1] + half, y[-1] - half, y[0] + half)

    def _plan_coarse_grids(self, lines: list[list[tuple[slice, slice, PatchKernel]]]) -> list[list[_Place]]:
        """Choose the coarse grids: columns for every patch, the rows in common; return the patches with theirs."""
        references = [line[len(line) // 2][2].beta for line in lines]
        bands = [
            [self._bandwidth(kernel, kernel.beta - reference) for _, _, kernel in line]
            for line, reference in zip(lines, references, strict=True)
        ]
        self._down = down = Resampling.of(self.grid.y_m, 2 * np.pi / max(band[1] for line in bands for band in line))

        def place(rows: slice, columns: slice, kernel: PatchKernel, band: float, reference: Polynomial) -> _Place:
            across = Resampling.of(self.grid.x_m, 2 * np.pi / band)
            stencil = fit_stencil(kernel, self._amplitude(kernel, dead=False), (across.pitch_m, down.pitch_m))
            return _Place(rows, columns, kernel, across, stencil, reference)

        return [
            [place(*cell, band[0], reference) for cell, band in zip(line, line_bands, strict=True)]
            for line, line_bands, reference in zip(lines, bands, references, strict=True)
        ]

    def _bandwidth(self, kernel: PatchKernel, wave: Polynomial) -> tuple[float, float]:
        """Return the bandwidth (radians per metre of the pupil) of a patch's field along x and along y.

        `wave` is what its carrier leaves of the patch's wave, a function of x apart.
        """
        t = np.linspace(-1, 1, 17)
        at, step = t * self.radius_m, (t[1] - t[0]) * self.radius_m
        inside = np.hypot(*np.meshgrid(t, t)) <= 1.01
        box = kernel.gx.box
        corners = (np.array([box.x0, box.x1]), np.array([box.y0, box.y1]))
        gx, gy = (g.on_grid(*corners).reshape(-1, 1) for g in (kernel.gx, kernel.gy))
        ux, uy, rest = kernel.ux.on_grid(at, at), kernel.uy.on_grid(at, at), _rest(wave, at, at, axis=1)
        widest = []
        for axis in (1, 0):
            dux, duy, slope = (np.gradient(part, step, axis=axis)[inside] for part in (ux, uy, rest))
            widest.append(2 * float(np.abs(gx * dux + gy * duy + slope).max()))
        return widest[0], widest[1]

    def _plan_sums(self, lines: list[list[_Place]]) -> None:
        """Make the matrices that bring pieces to the fine columns and rows and sum them there.

        Each piece's phase over the pupil, relative to that of its line's middle patch, is split in a function of x,
        carried by the fine columns, and a rest, which the coarse grid can hold; likewise lines and y.
        """
        fine_x, fine_y = self.grid.x_m, self.grid.y_m
        middles = [line[0].reference for line in lines]
        common = middles[len(middles) // 2]
        self._to_columns = [
            [p.across.matrices(_along(p.kernel.beta - p.reference, fine_x, axis=1)) for p in line] for line in lines
        ]
        self._to_rows = [self._down.matrices(_along(middle - common, fine_y, axis=0)) for middle in middles]
        self._rests = [
            torch.from_numpy(unit_phase(_rest(middle - common, fine_x, self._down.coarse_m, axis=0)))
            for middle in middles
        ]
        mean = 2 * np.pi / self.wavelength_m * self.grid.mean_path_m(fine_x[None], fine_y[:, None])
        self._common = torch.from_numpy(unit_phase(common.on_grid(fine_x, fine_y) + mean) * self.transmission)

    def _plan_patch(self, place: _Place) -> _Patch:
        import finufft

        kernel = place.kernel
        x, y = self.panel.x_m[place.columns], self.panel.y_m[place.rows]
        coarse = place.across.coarse_m, self._down.coarse_m
        margin = (TAPS / 2 + 1) * max(place.across.pitch_m, self._down.pitch_m)
        needed = np.flatnonzero(np.hypot(coarse[0][:, None], coarse[1][None]) <= self.radius_m + margin)
        # The patch's grid of 250 x 250 stays in the cache: sorting its points costs more than it saves.
        plan = finufft.Plan(3, 2, eps=NUFFT_EPS, isign=1, dtype="complex64", nthreads=1, spread_sort=0)
        plan.setpts(
            *(np.ascontiguousarray(g.on_grid(x, y).ravel(), dtype=np.float32) for g in (kernel.gx, kernel.gy)),
            None,
            *(_turned(u, coarse).ravel()[needed] for u in (kernel.ux, kernel.uy)),
        )
        return self._patch(place, place.stencil, plan, needed)

    def _patch(self, place: _Place, stencil: Stencil, plan: Any, needed: NDArray[np.intp]) -> _Patch:
        rows, columns = place.rows, place.columns
        x, y = self.panel.x_m[columns], self.panel.y_m[rows]
        _, tilt_per_m = self.panel.illumination_frequency_per_m
        phase = unit_phase(place.kernel.alpha.on_grid(x, y) + 2 * np.pi * tilt_per_m * y[:, None])
        phase *= stencil.from_panel.on_grid(x, y).astype(np.float32)
        if self._illumination is not None:
            phase *= self._illumination[rows, columns]
        coarse = place.across.coarse_m, self._down.coarse_m
        rest = _rest(place.kernel.beta - place.reference, *coarse, axis=1)
        carrier = unit_phase((rest + stencil.constant.on_grid(*coarse)).T)
        first = tuple(0.5 * _turned(part, coarse)[1:-1, 1:-1] for part in stencil.first)
        second = tuple(
            share * _turned(part, coarse)[1:-1, 1:-1] for share, part in zip((1, 1, 0.25), stencil.second, strict=True)
        )
        return _Patch(plan, rows, columns, phase, needed, _turned(stencil.to_pupil, coarse), first, second, carrier)

    def _amplitude(self, kernel: PatchKernel, *, dead: bool) -> Array:
        """Return what a pixel's active square, or its dead frame, sends to the pupil, per unit amplitude on the panel.

        An aperture of side a turns light of frequency f_in into f_out with sinc(a (f_out - f_in)) per axis. The values
        are at the nodes of patch and pupil.
        """
        pitch = self.panel.pitch_m
        amplitude = kernel.amplitude * (pitch**2 / self.wavelength_m)
        if self.fill_factor is None:
            return amplitude
        fx_in, fy_in = self.panel.illumination_frequency_per_m
        side = pitch * np.sqrt(self.fill_factor)
        fx, fy = kernel.fx - fx_in, kernel.fy - fy_in
        active = self.fill_factor * np.sinc(side * fx) * np.sinc(side * fy)
        return np.asarray(amplitude * (np.sinc(pitch * fx) * np.sinc(pitch * fy) - active if dead else active))

    def _dead_space(self, patches: list[_Patch]) -> torch.Tensor:
        """Return the field in the pupil of the light that the frames between the pixels send, unmodulated.

        It comes to a focus, a millimetre wide at most, at the diffraction orders of the pixels. On the thesis's bench
        the nearest lies 1.8 mm outside of the pupil's rim, and what strays in is 0.3 % of the field.
        """

        def piece(job: tuple[_Patch, _Place]) -> torch.Tensor:
            patch, place = job
            step = place.across.pitch_m, self._down.pitch_m
            stencil = fit_stencil(place.kernel, self._amplitude(place.kernel, dead=True), step)
            return _piece(self._patch(place, stencil, patch.plan, patch.needed), None)

        return self._sum(list(self._pool.map(piece, zip(patches, self._places, strict=True))))

    def field(self, modulation: Complex) -> Complex:
        """Return the field inside the pupil, (rows, columns) complex64 on `grid`, of a (height, width) modulation.

        It comes with y, ascending, along its first axis and x along its second, and without the grid's mean wave.
        Power is kept: the sum of |field|^2 times the cell's area is the power that passes the pupil, out of pitch^2 per
        panel pixel of modulus 1.
        """
        patches = [patch.result() for patch in self._patches]
        if self._unmodulated is None and self.fill_factor is not None and self.fill_factor < 1:
            self._unmodulated = self._dead_space(patches)
        field = self._sum(list(self._pool.map(lambda patch: _piece(patch, modulation), patches)))
        if self._unmodulated is not None:
            field += self._unmodulated
        return np.asarray(field.numpy())

    def _sum(self, pieces: list[torch.Tensor]) -> torch.Tensor:
        n_x, n_y = len(self.grid.x_m), len(self.grid.y_m)
        most = max(matrix.shape[0] * matrix.shape[1] for line in self._to_columns for matrix in line)
        line = torch.empty((most, pieces[0].shape[1]), dtype=torch.complex64)
        total = torch.empty((self._down.blocks * self._down.per_block, n_x), dtype=torch.complex64)
        left = iter(pieces)
        for i, (matrices, rest, to_rows) in enumerate(zip(self._to_columns, self._rests, self._to_rows, strict=True)):
            for j, matrix in enumerate(matrices):
                add_piece(next(left), matrix, out=line, first=j == 0)
            add_piece(transposed(line[:n_x]).mul_(rest), to_rows, out=total, first=i == 0)
        return total[:n_y].mul_(self._common)


def _piece(patch: _Patch, modulation: Complex | None) -> torch.Tensor:
    """Return a patch's field at its coarse points, (columns, rows), 0 where it is not needed."""
    source = patch.phase if modulation is None else modulation[patch.rows, patch.columns] * patch.phase
    piece = np.zeros(patch.carrier.shape, np.complex64)
    piece.ravel()[patch.needed] = patch.plan.execute(source.ravel())
    apply(piece, patch.to_pupil, patch.first, patch.second)
    piece *= patch.carrier
    return torch.from_numpy(piece)


def _groups(columns: Sequence[slice], most: int) -> list[Sequence[slice]]:
    """Cut a row of patches in lines of at most so many, about equally long."""
    count = -(-len(columns) // most)
    edges = np.linspace(0, len(columns), count + 1).round().astype(int)
    return [columns[a:b] for a, b in pairwise(edges)]


def _cuts(places: Array, wanted_px: Array) -> list[slice]:
    """Cut pixels at `places` in patches about as wide as wanted around each of them, (n,) pixels."""
    density = np.concatenate([[0.0], np.cumsum(1 / wanted_px)])
    count = int(np.ceil(density[-1] - 1e-9))
    edges = np.interp(np.linspace(0, density[-1], count + 1), density, np.arange(len(places) + 1)).round().astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def _along(phase: Polynomial, at: Array, *, axis: int) -> Array:
    """Return a phase on the axis y = 0 (`axis` 1: a function of x) or x = 0 (`axis` 0: a function of y)."""
    zero = np.zeros(1)
    return phase.on_grid(at, zero)[0] if axis == 1 else phase.on_grid(zero, at)[:, 0]


def _rest(phase: Polynomial, x: Array, y: Array, *, axis: int) -> Array:
    """Return a phase on a grid, (len(y), len(x)), less its values `_along` an axis."""
    if axis == 1:
        return phase.on_grid(x, y) - _along(phase, x, axis=1)[None]
    return phase.on_grid(x, y) - _along(phase, y, axis=0)[:, None]


def _turned(values: Polynomial, coarse: tuple[Array, Array]) -> NDArray[np.float32]:
    """Return a polynomial at coarse points, (columns, rows)."""
    return np.ascontiguousarray(values.on_grid(*coarse).T, np.float32)
