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
from holocal.optics.raytrace import trace_to_pupil
from rigs.simulated.kernel import Box, PatchKernel, PathTable, Polynomial, fit_patch, interpolate
from rigs.simulated.pupil import Complex, PupilGrid, unit_phase
from rigs.simulated.resample import TAPS, Resampling, add_piece, transposed

NUFFT_EPS = 1e-3  # relative, each patch; the phase model's 0.008 rad is the larger error
PATCH_PX = (256, 240)  # patch in the panel's middle, columns and rows, for a phase error of 0.008 rad rms
# The mirror is nearer to +x directions: there patches are narrower, else they leave 0.023 rad and those at -x 0.004.
PATCH_SLOPE_PER_M = 60.0
# A line's pieces hold, beside the patch's own light, the bend of its wave against the middle patch's. Six patches: half
# the samples of a line of seventeen, and little more to add up.
LINE_PATCHES = 6


@dataclass(frozen=True)
class _Place:
    """A patch: which pixels, its phase model, its coarse columns, the wave of the patch in the middle of its line."""

    rows: slice
    columns: slice
    kernel: PatchKernel
    across: Resampling
    reference: Polynomial


@dataclass(frozen=True)
class _Patch:
    plan: Any
    rows: slice
    columns: slice
    phase: Complex  # illumination and alpha over the patch
    weight: Complex  # at the needed coarse points: filter of the pixel's active square, amplitude, rest of the carrier
    needed: NDArray[np.intp]  # which of the coarse points (columns, rows), flat
    shape: tuple[int, int]  # of the coarse points


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
        Widest patch, columns and rows.

    Attributes
    ----------
    grid
        The pupil's grid, and the mean wave that the field is stored without.
    residual_rad
        Rms of the phase that the patches' separable form leaves, mean over patches.
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
        patch_px: tuple[int, int] = PATCH_PX,
    ) -> None:
        self.panel, self.wavelength_m, self.fill_factor = panel, wavelength_m, fill_factor
        self.radius_m = (bench.pupil_diameter_m + pupil_edge_m) / 2  # outside of it no light passes
        half_x, half_y = panel.half_size_m
        reach = self.radius_m * 1.005
        table = PathTable.trace(bench, Box(-half_x, half_x, -half_y, half_y), Box(-reach, reach, -reach, reach))
        self.grid = PupilGrid.of(table, self.radius_m, wavelength_m, pupil_edge_m)
        self.transmission = self.grid.transmission(bench.pupil_diameter_m / 2, pupil_edge_m)
        self._pool = ThreadPoolExecutor(max(1, torch.get_num_threads()))
        rows = _cuts(panel.y_m, np.full(panel.height, float(patch_px[1])))
        columns = _cuts(panel.x_m, patch_px[0] * np.clip(1 - PATCH_SLOPE_PER_M * panel.x_m, 0.5, 1.5))
        cells = [[(r, c) for c in group] for r in rows for group in _groups(columns, LINE_PATCHES)]
        boxes = [self._box(*cell) for line in cells for cell in line]
        kernels = list(self._pool.map(lambda box: fit_patch(table, box, wavelength_m), boxes))
        self.residual_rad = float(np.mean([kernel.residual_rad for kernel in kernels]))
        fitted = iter(kernels)
        lines = self._plan_coarse_grids([[(*cell, next(fitted)) for cell in line] for line in cells])
        self._places = [place for line in lines for place in line]
        self._patches: list[Future[_Patch]] = [
            self._pool.submit(self._plan_patch, place, illumination) for place in self._places
        ]
        self._plan_sums(lines)
        self._dead = fill_factor is not None and fill_factor < 1 and self._order_in_reach(bench)
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
        self._down = Resampling.of(self.grid.y_m, 2 * np.pi / max(band[1] for line in bands for band in line))
        return [
            [
                _Place(rows, columns, kernel, Resampling.of(self.grid.x_m, 2 * np.pi / band[0]), reference)
                for (rows, columns, kernel), band in zip(line, line_bands, strict=True)
            ]
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

    def _plan_patch(self, place: _Place, illumination: NDArray[np.float32] | Complex | None) -> _Patch:
        import finufft

        kernel, rows, columns = place.kernel, place.rows, place.columns
        x, y = self.panel.x_m[columns], self.panel.y_m[rows]
        coarse_x, coarse_y = place.across.coarse_m, self._down.coarse_m
        margin = TAPS / 2 * max(place.across.pitch_m, self._down.pitch_m)
        needed = np.flatnonzero(np.hypot(coarse_x[:, None], coarse_y[None]) <= self.radius_m + margin)

        def at_coarse(values: Array) -> NDArray[np.float32]:
            return np.ascontiguousarray(values.T, np.float32).ravel()[needed]

        # The patch's grid of 200 x 200 stays in the cache: sorting its points costs more than it saves.
        plan = finufft.Plan(3, 2, eps=NUFFT_EPS, isign=1, dtype="complex64", nthreads=1, spread_sort=0)
        plan.setpts(
            *(np.ascontiguousarray(g.on_grid(x, y).ravel(), dtype=np.float32) for g in (kernel.gx, kernel.gy)),
            None,
            *(at_coarse(u.on_grid(coarse_x, coarse_y)) for u in (kernel.ux, kernel.uy)),
        )
        _, tilt_per_m = self.panel.illumination_frequency_per_m
        phase = unit_phase(kernel.alpha.on_grid(x, y) + 2 * np.pi * tilt_per_m * y[:, None])
        if illumination is not None:
            phase = phase * illumination[rows, columns]
        rest = unit_phase(_rest(kernel.beta - place.reference, coarse_x, coarse_y, axis=1).T).ravel()[needed]
        weight = rest * at_coarse(self._amplitude(kernel, dead=False).on_grid(coarse_x, coarse_y))
        return _Patch(plan, rows, columns, phase, weight, needed, (len(coarse_x), len(coarse_y)))

    def _amplitude(self, kernel: PatchKernel, *, dead: bool) -> Polynomial:
        """Return what a pixel's active square, or its dead frame, sends to the pupil, per unit amplitude on the panel.

        An aperture of side a turns light of frequency f_in into f_out with sinc(a (f_out - f_in)) per axis.
        """
        pupil = kernel.amplitude.box
        nodes = pupil.nodes(kernel.amplitude.coefficients.shape[0])
        pitch = self.panel.pitch_m
        amplitude = kernel.amplitude.on_grid(*nodes) * (pitch**2 / self.wavelength_m)
        if self.fill_factor is not None:
            fx_in, fy_in = self.panel.illumination_frequency_per_m
            side = pitch * np.sqrt(self.fill_factor)
            fx, fy = kernel.fx.on_grid(*nodes) - fx_in, kernel.fy.on_grid(*nodes) - fy_in
            active = self.fill_factor * np.sinc(side * fx) * np.sinc(side * fy)
            amplitude *= np.sinc(pitch * fx) * np.sinc(pitch * fy) - active if dead else active
        return interpolate(pupil, amplitude)

    def _dead_space(self, patches: list[_Patch]) -> torch.Tensor:
        """Return the field in the pupil of the light that the frames between the pixels send, unmodulated.

        It comes to a focus, a millimetre wide at most, at the diffraction orders of the pixels: where all of these lie
        outside of the pupil by more than that, there is none (what strays in is below 1e-4 of the signal).
        """

        def piece(job: tuple[_Patch, _Place]) -> torch.Tensor:
            (patch, place), across = job, job[1].across
            dead, active = (
                self._amplitude(place.kernel, dead=part).on_grid(across.coarse_m, self._down.coarse_m).T.ravel()
                for part in (True, False)
            )
            return _piece(patch, None, (dead[patch.needed] / active[patch.needed]).astype(np.float32))

        return self._sum(list(self._pool.map(piece, zip(patches, self._places, strict=True))))

    def _order_in_reach(self, bench: Bench) -> bool:
        """Return whether a diffraction order of the panel's middle lands within a millimetre of the pupil."""
        order = np.stack(np.meshgrid([-1, 0, 1], [-2, -1, 0, 1]), axis=-1).reshape(-1, 2) / self.panel.pitch_m
        sines = self.wavelength_m * (order + np.array(self.panel.illumination_frequency_per_m))
        along = np.sqrt(np.maximum(1 - np.sum(sines**2, axis=1, keepdims=True), 0))
        rays = trace_to_pupil(bench, np.zeros((len(sines), 2)), np.concatenate([sines, along], axis=1))
        return bool(np.any(rays.valid & (np.linalg.norm(rays.landing_m, axis=1) < self.radius_m + 1e-3)))

    def field(self, modulation: Complex) -> Complex:
        """Return the field inside the pupil, (rows, columns) complex64 on `grid`, of a (height, width) modulation.

        It comes with y, ascending, along its first axis and x along its second, and without the grid's mean wave.
        Power is kept: the sum of |field|^2 times the cell's area is the power that passes the pupil, out of pitch^2 per
        panel pixel of modulus 1.
        """
        patches = [patch.result() for patch in self._patches]
        if self._dead and self._unmodulated is None:
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


def _piece(patch: _Patch, modulation: Complex | None, factor: NDArray[np.float32] | None = None) -> torch.Tensor:
    """Return a patch's field at its coarse points, (columns, rows), 0 where it is not needed."""
    source = patch.phase if modulation is None else modulation[patch.rows, patch.columns] * patch.phase
    values = patch.plan.execute(source.ravel())
    values *= patch.weight if factor is None else patch.weight * factor
    piece = np.zeros(patch.shape, np.complex64)
    piece.ravel()[patch.needed] = values
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
