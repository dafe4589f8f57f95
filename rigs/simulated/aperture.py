"""The field in the pupil, from the levels on the panel: aperture synthesis, patch by patch.

    U(q) = pitch^2 / wavelength  sum_x  u(x) sqrt|det d2L/dx dq|  exp(i k L(x, q))           (unitary: power is kept)

1. Each patch of the panel gives its own small piece of the field, on a coarse grid of the pupil: a non-uniform Fourier
   transform in the patch's own warped coordinates (FINUFFT type 3), because a small patch cannot make fine detail.
2. The pieces of a column of patches are brought to the pupil's fine rows by a polyphase filter, each on its own
   carrier, and added: one small matrix product per block of fine rows does all three.
3. The columns are brought to the fine columns likewise. The result is the whole field on the fine grid.

The cost is a few operations per panel pixel and about twenty per pupil sample, instead of one per pair of them.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array, Bench, Panel
from holocal.optics.raytrace import trace_to_pupil
from rigs.simulated.kernel import Box, PatchKernel, PathTable, Polynomial, fit_patch, interpolate
from rigs.simulated.pupil import Complex, PupilGrid, unit_phase

NUFFT_EPS = 1e-3  # relative, each patch; the phase model's 0.008 rad is the larger error
TAPS = 16  # of the polyphase filter, per output sample
OVERSAMPLING = 1.4  # of the coarse grids, against the widest piece's bandwidth: 16 taps then leave 1e-3
PATCH_PX = (256, 240)  # patch in the panel's middle, columns and rows, for a phase error of 0.008 rad rms
# The mirror is nearer to +x directions: there patches are narrower, else they leave 0.023 rad and those at -x 0.004.
PATCH_SLOPE_PER_M = 60.0


def polyphase(ratio: int, bandwidth: float) -> NDArray[np.float32]:
    """Return the (TAPS, ratio) filter that interpolates a sequence `ratio` times finer.

    `bandwidth` is the signal's, as a share of the coarse sampling rate (below 1). Kaiser-windowed sinc.
    """
    transition = 2 * np.pi * (1 - bandwidth)
    attenuation = 2.285 * (TAPS - 1) * transition + 7.95
    beta = 0.1102 * (attenuation - 8.7) if attenuation > 50 else 0.5842 * (attenuation - 21) ** 0.4
    tap = np.arange(TAPS)[:, None] - (TAPS // 2 - 1)
    offset = tap - np.arange(ratio)[None] / ratio
    window = np.i0(beta * np.sqrt(np.maximum(0.0, 1 - (offset / (TAPS / 2)) ** 2))) / np.i0(beta)
    taps = np.sinc(offset) * window
    return np.asarray(taps / taps.sum(axis=0), np.float32)


@dataclass(frozen=True)
class _Patch:
    plan: Any
    rows: slice
    columns: slice
    phase: Complex  # illumination and alpha over the patch
    weight: Complex  # at the needed coarse points: filter of the pixel's active square, amplitude, rest of the carrier


class PanelToPupil:
    """The linear map from the panel's pixels to the pupil, for one bench and one wavelength.

    Parameters
    ----------
    bench
        The true, misaligned bench.
    panel
        The panel's pixels.
    wavelength_m
        Metres.
    illumination
        (height, width) amplitude of the light on the panel, without its tilt, or None for 1.
    fill_factor
        Share of a pixel's area that is modulated, or None for point-like pixels (no sinc envelope, no zero order).
    pupil_edge_m
        Width over which the pupil's transmission falls from 1 to 0, half way at its nominal rim.
    patch_px
        Widest patch, columns and rows.

    Attributes
    ----------
    grid
        The pupil's fine grid.
    residual_rad
        Rms of the phase that the patches' separable form leaves, mean over patches.
    """

    def __init__(
        self,
        bench: Bench,
        panel: Panel,
        wavelength_m: float,
        *,
        illumination: NDArray[np.float32] | None = None,
        fill_factor: float | None = None,
        pupil_edge_m: float = 2e-4,
        patch_px: tuple[int, int] = PATCH_PX,
    ) -> None:
        self.panel, self.wavelength_m, self.fill_factor = panel, wavelength_m, fill_factor
        self.radius_m = (bench.pupil_diameter_m + pupil_edge_m) / 2  # outside of it no light passes
        half_x, half_y = panel.half_size_m
        reach = self.radius_m * 1.005
        table = PathTable.trace(bench, Box(-half_x, half_x, -half_y, half_y), Box(-reach, reach, -reach, reach))
        self.grid = PupilGrid.of(table, self.radius_m, wavelength_m)
        self.transmission = self.grid.transmission(bench.pupil_diameter_m / 2, pupil_edge_m)
        self._pool = ThreadPoolExecutor(max(1, torch.get_num_threads()))
        rows = _cuts(panel.y_m, np.full(panel.height, float(patch_px[1])))
        columns = _cuts(panel.x_m, patch_px[0] * np.clip(1 - PATCH_SLOPE_PER_M * panel.x_m, 0.5, 1.5))
        boxes = [[(self._box(r, c), r, c) for r in rows] for c in columns]  # by columns of patches
        kernels = [[fit_patch(table, box, wavelength_m) for box, *_ in line] for line in boxes]
        self.residual_rad = float(np.mean([kernel.residual_rad for line in kernels for kernel in line]))
        self._plan_coarse_grids(kernels)
        self._plan_sums(kernels)
        jobs = [
            (kernel, line[len(rows) // 2].beta, box[1], box[2])
            for line, places in zip(kernels, boxes, strict=True)
            for kernel, box in zip(line, places, strict=True)
        ]
        plan = self._plan_patch
        self._patches = list(self._pool.map(lambda job: plan(job[0], job[1], job[2], job[3], illumination), jobs))
        self._unmodulated = self._dead_space(bench, [job[0] for job in jobs])

    def _box(self, rows: slice, columns: slice) -> Box:
        x, y, half = self.panel.x_m[columns], self.panel.y_m[rows], self.panel.pitch_m / 2
        return Box(x[0] - half, x[-1] + half, y[-1] - half, y[0] + half)

    def _plan_coarse_grids(self, kernels: list[list[PatchKernel]]) -> None:
        """Choose the coarse grids: a divisor of the fine grid that oversamples every patch's own bandwidth."""
        ratios, fine = [], (self.grid.x_m, self.grid.y_m)
        widest = self._bandwidths(kernels)
        for axis in (0, 1):
            critical = 2 * np.pi / widest[axis]
            ratio = max(1, int(critical / OVERSAMPLING / self.grid.pitch_m[axis]))
            ratios.append((ratio, ratio * self.grid.pitch_m[axis] / critical))
        self._filters = [polyphase(ratio, band) for ratio, band in ratios]
        self._coarse = []
        for axis in (0, 1):
            ratio = ratios[axis][0]
            blocks = -(-len(fine[axis]) // ratio)
            first = fine[axis][0] - (TAPS // 2 - 1) * ratio * self.grid.pitch_m[axis]
            self._coarse.append(first + np.arange(blocks + TAPS - 1) * ratio * self.grid.pitch_m[axis])
        reach = self.radius_m + TAPS / 2 * max(r[0] * p for r, p in zip(ratios, self.grid.pitch_m, strict=True))
        self._needed = np.hypot(self._coarse[0][None], self._coarse[1][:, None]) <= reach

    def _bandwidths(self, kernels: list[list[PatchKernel]]) -> tuple[float, float]:
        """Return the widest bandwidth (radians per metre of the pupil) of a patch's field along x and along y."""
        t = np.linspace(-1, 1, 17)
        x, y, step = t * self.radius_m, t * self.radius_m, (t[1] - t[0]) * self.radius_m
        inside = np.hypot(*np.meshgrid(t, t)) <= 1.01
        widest = [0.0, 0.0]
        for line in kernels:
            reference = line[len(line) // 2].beta
            for kernel in line:
                patch = kernel.gx.box
                ends = np.array([[kernel.gx.on_grid(np.array([px]), np.array([py]))[0, 0],
                                  kernel.gy.on_grid(np.array([px]), np.array([py]))[0, 0]]
                                 for px in (patch.x0, patch.x1) for py in (patch.y0, patch.y1)])  # fmt: skip
                ux, uy = kernel.ux.on_grid(x, y), kernel.uy.on_grid(x, y)
                rest = _rest(kernel.beta - reference, x, y, axis=0)
                for axis in (0, 1):
                    dux, duy, slope = (np.gradient(part, step, axis=1 - axis)[inside] for part in (ux, uy, rest))
                    reach = ends[:, :1] * dux + ends[:, 1:] * duy + slope
                    widest[axis] = max(widest[axis], 2 * float(np.abs(reach).max()))
        return widest[0], widest[1]

    def _plan_sums(self, kernels: list[list[PatchKernel]]) -> None:
        """Make the matrices that bring pieces to the fine rows and columns and sum them there.

        Each piece's phase over the pupil, relative to that of its column's middle patch, is split in a function of y,
        carried by the fine rows, and a rest, which the coarse grid can hold; likewise columns and x.
        """
        k = 2 * np.pi / self.wavelength_m
        fine_x, fine_y = self.grid.x_m, self.grid.y_m
        middles = [line[len(line) // 2].beta for line in kernels]
        common = middles[len(middles) // 2]
        self._to_rows = [
            _matrices(self._filters[1], [_along(kernel.beta - middle, fine_y, axis=0) for kernel in line])
            for line, middle in zip(kernels, middles, strict=True)
        ]
        self._to_columns = _matrices(self._filters[0], [_along(middle - common, fine_x, axis=1) for middle in middles])
        self._rests = [
            np.ascontiguousarray(unit_phase(_rest(middle - common, self._coarse[0], fine_y, axis=1)).T)
            for middle in middles
        ]
        tilt = k * (self.grid.carrier[0] * fine_x[None] + self.grid.carrier[1] * fine_y[:, None])
        common_phase = unit_phase((common.on_grid(fine_x, fine_y) + tilt).T)
        self._common = torch.from_numpy(common_phase * self.transmission)

    def _plan_patch(
        self,
        kernel: PatchKernel,
        reference: Polynomial,
        rows: slice,
        columns: slice,
        illumination: NDArray[np.float32] | None,
    ) -> _Patch:
        import finufft

        x, y = self.panel.x_m[columns], self.panel.y_m[rows]
        (coarse_x, coarse_y), needed = self._coarse, self._needed
        plan = finufft.Plan(3, 2, eps=NUFFT_EPS, isign=1, dtype="complex64", nthreads=1)
        plan.setpts(
            *(np.ascontiguousarray(g.on_grid(x, y).ravel(), dtype=np.float32) for g in (kernel.gx, kernel.gy)),
            None,
            *(u.on_grid(coarse_x, coarse_y)[needed].astype(np.float32) for u in (kernel.ux, kernel.uy)),
        )
        _, tilt_per_m = self.panel.illumination_frequency_per_m
        phase = unit_phase(kernel.alpha.on_grid(x, y) + 2 * np.pi * tilt_per_m * y[:, None])
        if illumination is not None:
            phase = phase * illumination[rows, columns]
        rest = _rest(kernel.beta - reference, coarse_x, coarse_y, axis=0)
        amplitude = self._amplitude(kernel, dead=False).on_grid(coarse_x, coarse_y)
        weight = unit_phase(rest) * amplitude.astype(np.float32)
        return _Patch(plan, rows, columns, phase, weight[needed])

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

    def _dead_space(self, bench: Bench, kernels: list[PatchKernel]) -> torch.Tensor | None:
        """Return the field in the pupil of the light that the frames between the pixels send, unmodulated.

        It comes to a focus, a millimetre wide at most, at the diffraction orders of the pixels: where all of these lie
        outside of the pupil by more than that, there is none (what strays in is below 1e-4 of the signal).
        """
        if self.fill_factor is None or self.fill_factor == 1 or not self._order_in_reach(bench):
            return None

        def piece(job: tuple[_Patch, PatchKernel]) -> Complex:
            dead, active = (self._amplitude(job[1], dead=part).on_grid(*self._coarse) for part in (True, False))
            return self._piece(job[0], None, (dead[self._needed] / active[self._needed]).astype(np.float32))

        return self._sum(list(self._pool.map(piece, zip(self._patches, kernels, strict=True))))

    def _order_in_reach(self, bench: Bench) -> bool:
        """Return whether a diffraction order of the panel's middle lands within a millimetre of the pupil."""
        order = np.stack(np.meshgrid([-1, 0, 1], [-2, -1, 0, 1]), axis=-1).reshape(-1, 2) / self.panel.pitch_m
        sines = self.wavelength_m * (order + np.array(self.panel.illumination_frequency_per_m))
        along = np.sqrt(np.maximum(1 - np.sum(sines**2, axis=1, keepdims=True), 0))
        rays = trace_to_pupil(bench, np.zeros((len(sines), 2)), np.concatenate([sines, along], axis=1))
        return bool(np.any(rays.valid & (np.linalg.norm(rays.landing_m, axis=1) < self.radius_m + 1e-3)))

    def field(self, modulation: Complex) -> Complex:
        """Return the field inside the pupil, (columns, rows) complex64 on `grid`, of a (height, width) modulation.

        It comes with x along its first axis and y, ascending, along its second. Power is kept: the sum of |field|^2
        times the cell's area is the power that passes the pupil, out of pitch^2 per panel pixel of modulus 1.
        """
        field = self._sum(list(self._pool.map(lambda patch: self._piece(patch, modulation), self._patches)))
        if self._unmodulated is not None:
            field += self._unmodulated
        return np.asarray(field.numpy())

    def _sum(self, pieces: list[Complex]) -> torch.Tensor:
        rows, columns = len(self.grid.y_m), len(self.grid.x_m)
        lines, n = [], len(pieces) // len(self._rests)
        fine = None
        for i, (matrices, rest) in enumerate(zip(self._to_rows, self._rests, strict=True)):
            column = [torch.from_numpy(piece) for piece in pieces[i * n : (i + 1) * n]]
            fine = _combine(column, matrices, out=fine)
            pairs = fine.flatten(0, 1)[:rows].numpy().view(np.float32).reshape(rows, -1, 2)
            turned = cv2.transpose(pairs).view(np.complex64)[..., 0]  # four times as fast as a strided copy
            turned *= rest
            lines.append(torch.from_numpy(turned))
        return _combine(lines, self._to_columns).flatten(0, 1)[:columns].mul_(self._common)

    def _piece(self, patch: _Patch, modulation: Complex | None, factor: NDArray[np.float32] | None = None) -> Complex:
        source = patch.phase if modulation is None else modulation[patch.rows, patch.columns] * patch.phase
        piece = np.zeros(self._needed.shape, np.complex64)
        values = patch.plan.execute(source.ravel()) * patch.weight
        piece[self._needed] = values if factor is None else values * factor
        return piece


def _combine(
    pieces: list[torch.Tensor], matrices: list[torch.Tensor], *, out: torch.Tensor | None = None
) -> torch.Tensor:
    """Return the sum of the pieces, (blocks, ratio, m), each (blocks + TAPS - 1, m) brought to the fine grid."""
    for i, (piece, matrix) in enumerate(zip(pieces, matrices, strict=True)):
        windows = piece.unfold(0, TAPS, 1).transpose(1, 2)  # (blocks, taps, m), a view
        if out is None:
            out = torch.empty((*matrix.shape[:2], piece.shape[1]), dtype=torch.complex64)
        torch.baddbmm(out, matrix, windows, beta=1 if i else 0, out=out)
    assert out is not None
    return out


def _matrices(taps: NDArray[np.float32], carriers_rad: list[Array]) -> list[torch.Tensor]:
    """Return, per piece, (blocks, ratio, TAPS) matrices: the polyphase filter times exp(i carrier) of fine samples."""
    ratio, out = taps.shape[1], []
    for carrier in carriers_rad:
        blocks = -(-len(carrier) // ratio)
        padded = np.concatenate([unit_phase(carrier), np.zeros(blocks * ratio - len(carrier), np.complex64)])
        out.append(torch.from_numpy(padded.reshape(blocks, ratio, 1) * taps.T))
    return out


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
