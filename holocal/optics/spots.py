"""The waves of a few virtual points over the whole panel, as small plane waves, and the adjoint.

Over a block of 4 x 4 pixels the phase function of a point is a plane wave to 0.002 rad (4K panel, 515 nm), so a wave
costs one complex product per pixel and no sine: 25 points take some 8 FFT pairs of the panel's size. `synthesise` adds
waves up to a field; `analyse` is its adjoint: what a field on the panel holds of each wave, block by block. With the
pupil points q of the blocks that is the field in the pupil along directions near the point's own,

    E_p(s + ds) = sum_x u(x) exp(-i phi_p(x)) exp(i k q_p(x) . ds)

to first order in ds, s being direction sines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from holocal.errors import SamplingError
from holocal.optics.bench import Array, Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.series import Series, fit_series

BLOCK = 4  # pixels each way
_DEGREES = (16, 24, 32)  # of phase and pupil point over the panel
_TAIL_RAD = 1e-2  # in the last two degrees together
_BAND = 32  # rows of blocks at a time: what is worked on stays in the cache

PhaseOfPupil = Callable[[Array], Array]  # pupil points (n, points, 2) metres -> radians (n, points)


@dataclass(frozen=True)
class SpotWaves:
    """The phase functions of points on a panel.

    `turns` is a series of (points,) phases over the panel, in turns; `pupil` one of (points, 2) pupil points q, metres
    in P, that the light crosses on its way to the point.
    """

    panel: Panel
    turns: Series
    pupil: Series

    @property
    def count(self) -> int:
        """How many points there are."""
        return int(self.turns.coefficients.shape[2])

    def with_phase(self, added: PhaseOfPupil) -> SpotWaves:
        """Return the waves with a phase added that is a smooth function of the pupil point, radians.

        Raises
        ------
        SamplingError
            The added phase is not smooth over the panel.
        """

        def turns(slm_m: Array) -> Array:
            return added(self.pupil.at(slm_m)) / (2 * np.pi)

        more = _smooth(turns, self.panel, "The added phase")
        return replace(self, turns=self.turns + more)

    def block_grid(self, block: int = BLOCK) -> tuple[Array, Array]:
        """Return the blocks' centres: x (columns,) ascending and y (rows,) descending, metres in S.

        A block that reaches beyond the panel keeps its own centre; the pixels that are not there are dark.
        """
        panel = self.panel
        columns, rows = -(-panel.width // block), -(-panel.height // block)
        middle = (block - 1) / 2
        return (
            panel.x_m[0] + (np.arange(columns) * block + middle) * panel.pitch_m,
            panel.y_m[0] - (np.arange(rows) * block + middle) * panel.pitch_m,
        )


def spot_waves(
    bench: Bench,
    panel: Panel,
    points: VirtualPoints,
    *,
    wavelength_m: float,
    gaze_rad: tuple[float, float] = (0.0, 0.0),
) -> SpotWaves:
    """Return the phase functions of points (n,) by their exact path lengths, as series over the panel.

    Raises
    ------
    SamplingError
        A point is so near that its phase is not smooth over the panel, or its rays are not found.
    """

    def traced(slm_m: Array) -> Array:
        found = exact_phase(bench, points, slm_m[:, None], wavelength_m=wavelength_m, gaze_rad=gaze_rad)
        return np.concatenate([found.phase_rad[..., None] / (2 * np.pi), found.pupil_m], axis=-1)

    both = _smooth(traced, panel, "The phase of a point", first=True)
    coefficients = both.coefficients
    return SpotWaves(
        panel, replace(both, coefficients=coefficients[..., 0]), replace(both, coefficients=coefficients[..., 1:])
    )


def _smooth(function: Callable[[Array], Array], panel: Panel, what: str, *, first: bool = False) -> Series:
    """Return the series of a function in turns (n, points), or with `first` of (n, points, 3), turns first."""
    for degree in _DEGREES:
        found = fit_series(function, degree=degree, centre=(0.0, 0.0), half=panel.half_size_m)
        size = np.abs(found.coefficients[..., 0] if first else found.coefficients)
        tail = 2 * np.pi * float(np.max(size[-2:].sum(axis=(0, 1)) + size[:, -2:].sum(axis=(0, 1))))
        if tail <= _TAIL_RAD:
            return found
    raise SamplingError(
        f"{what} is not smooth over the panel: polynomials of degree {_DEGREES[-1]} leave {tail:.2g} rad.",
        fix="Use points farther away, and a weaker added phase.",
        measured=tail,
        limit=_TAIL_RAD,
    )


def synthesise(
    waves: SpotWaves,
    amplitude: NDArray[np.complex128],
    window: Callable[[Array], Array],
    *,
    reach_m: float,
    device: str = "cpu",
    block: int = BLOCK,
) -> torch.Tensor:
    """Return sum_p a_p A(q_p(x)) exp(i phi_p(x)), (height, width) complex64.

    Parameters
    ----------
    amplitude
        (points,) a_p.
    window
        A: pupil points (..., 2) metres to amplitudes (...); 0 beyond `reach_m` from the pupil's centre.
    """
    panel = waves.panel
    columns, rows = (-(-n // block) for n in (panel.width, panel.height))
    total = torch.zeros((rows, block, columns, block), dtype=torch.complex64, device=device)
    for point, part in _parts(waves, reach_m, block):
        centre = part.centre() * (amplitude[point] * window(part.pupil())).astype(np.complex64)
        along_x, along_y = part.carriers(device)
        along_y *= torch.from_numpy(centre).to(device)[:, None, :]
        total[part.rows, :, part.columns] += along_y[..., None] * along_x[:, None]
    return total.reshape(rows * block, columns * block)[: panel.height, : panel.width].contiguous()


def analyse(
    waves: SpotWaves, field: torch.Tensor, *, reach_m: float, block: int = BLOCK, sent: SpotWaves | None = None
) -> list[tuple[Array, NDArray[np.complex64]]]:
    """Return for each point pupil points q (n, 2) of the blocks' corners within reach, and sum w u exp(-i phi_p) there.

    w falls from a corner to 0 over a block each way: the sums of all corners are that of all pixels, so that this is
    the adjoint of `synthesise` with a window of 1. Blocks without such weights would take light from a quarter of a
    diffraction order away (for 4 pixels) for the point's own. Light from directions ds beside the point's adds up to
    less by sinc^2 of k ds . dq / 2 pi a way, dq being a block's step in the pupil.

    `field` is (height, width) complex64, the values are complex64. With `sent` each corner counts as the area of its
    pixels sends these waves: times the sinc of the frequency that they leave with, less that of the illumination.
    """
    height, width = field.shape
    columns, rows = -(-width // block), -(-height // block)
    if (rows * block, columns * block) != (height, width):
        field = torch.nn.functional.pad(field, (0, columns * block - width, 0, rows * block - height))
    blocks = field.reshape(rows, block, columns, block)
    sums: dict[int, torch.Tensor] = {}
    lit: dict[int, tuple[slice, slice]] = {}
    for point, part in _parts(waves, reach_m, block):
        if point not in sums:
            sums[point] = torch.zeros((rows + 1, columns + 1), dtype=torch.complex64, device=field.device)
        corners = _to_corners(blocks, part)
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            where = (_moved(part.rows, down), _moved(part.columns, right))
            sums[point][where] += corners[down][right]
        before = lit.get(point, (part.rows, part.columns))
        lit[point] = (_around(before[0], part.rows), _around(before[1], part.columns))
    found: list[tuple[Array, NDArray[np.complex64]]] = []
    x, y = waves.block_grid(block)
    half = block / 2 * waves.panel.pitch_m
    x, y = np.append(x - half, x[-1] + half), np.append(y + half, y[-1] - half)
    for point in range(waves.count):
        if point not in sums:
            found.append((np.zeros((0, 2)), np.zeros(0, np.complex64)))
            continue
        height_lit, width_lit = (slice(one.start, one.stop + 1) for one in lit[point])
        part = _Part(waves, point, height_lit, width_lit, x[width_lit], y[height_lit], block)
        pupil, values = part.pupil(), sums[point][height_lit, width_lit].cpu().numpy()
        if sent is not None:
            values = values * replace(part, waves=sent).areas()
        near = np.hypot(pupil[..., 0], pupil[..., 1]) <= reach_m
        found.append((pupil[near], values[near]))
    return found


def _to_corners(blocks: torch.Tensor, part: _Part) -> list[list[torch.Tensor]]:
    """Return what the blocks of a part add to their corners, [top, bottom][left, right] of (rows, columns) each."""
    block = part.block
    along_x, along_y = (one.conj() for one in part.carriers(str(blocks.device)))
    centre = torch.from_numpy(part.centre()).to(blocks.device).conj()
    share = [(j + 0.5) / block for j in range(block)]  # of a pixel, that goes to the farther corner
    whole = bottom = None
    for j in range(block):
        line = blocks[part.rows, j, part.columns] * along_y[:, j, :, None]
        whole = line if whole is None else whole + line
        bottom = share[j] * line if bottom is None else bottom + share[j] * line
    assert whole is not None
    assert bottom is not None
    out = []
    for held in (whole - bottom, bottom):
        turned = held * along_x
        total = torch.sum(turned, dim=-1) * centre
        right = torch.sum(turned * torch.tensor(share, device=blocks.device), dim=-1) * centre
        out.append([total - right, right])
    return out


def _moved(part: slice, by: int) -> slice:
    return slice(part.start + by, part.stop + by)


def _around(one: slice, other: slice) -> slice:
    return slice(min(one.start, other.start), max(one.stop, other.stop))


@dataclass(frozen=True)
class _Part:
    """A point's wave over a rectangle of blocks."""

    waves: SpotWaves
    point: int
    rows: slice
    columns: slice
    x_m: Array
    y_m: Array
    block: int

    def pupil(self) -> Array:
        """Return q of the blocks' centres, (rows, columns, 2)."""
        return self._of(self.waves.pupil).on_grid(self.x_m, self.y_m)

    def centre(self) -> NDArray[np.complex64]:
        """Return exp(i phi) at the blocks' centres."""
        turns = self._of(self.waves.turns).on_grid(self.x_m, self.y_m)
        return _phasor(2 * np.pi * (turns - np.round(turns))).numpy()

    def areas(self) -> NDArray[np.float32]:
        """Return what a pixel's area sends of the wave, (rows, columns), 1 for light that is not turned."""
        series, panel = self._of(self.waves.turns), self.waves.panel
        made = np.ones((1, 1))
        for axis, own in zip((1, 0), panel.illumination_frequency_per_m, strict=True):
            turned = derivative(series, axis).on_grid(self.x_m, self.y_m) - own
            made = made * np.sinc(turned * panel.pitch_m)
        return np.asarray(made, np.float32)

    def carriers(self, device: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the plane wave's factors along x (rows, columns, block) and along y (rows, block, columns)."""
        series, pitch = self._of(self.waves.turns), self.waves.panel.pitch_m
        half = np.pi * pitch  # of a pixel, radians per turn per metre
        slope_x = derivative(series, 1).on_grid(self.x_m, self.y_m) * half
        slope_y = derivative(series, 0).on_grid(self.x_m, self.y_m) * half
        steps = np.arange(1 - self.block, self.block, 2)  # in halves of a pixel; rows run down
        along_x = torch.stack(_powers(_phasor(slope_x).to(device), steps), dim=2)
        along_y = torch.stack(_powers(_phasor(slope_y).to(device), -steps), dim=1)
        return along_x, along_y

    def _of(self, series: Series) -> Series:
        return replace(series, coefficients=series.coefficients[:, :, self.point])


def _parts(waves: SpotWaves, reach_m: float, block: int) -> Iterator[tuple[int, _Part]]:
    """Yield each point's wave in bands of blocks, cut to where its light crosses the pupil within reach."""
    x, y = waves.block_grid(block)
    for first in range(0, len(y), _BAND):
        rows = slice(first, min(first + _BAND, len(y)))
        coarse_x, coarse_y = x[:: max(1, len(x) // 64)], y[rows][:: max(1, _BAND // 8)]
        coarse_x, coarse_y = np.append(coarse_x, x[-1]), np.append(coarse_y, y[rows][-1])
        pupil = waves.pupil.on_grid(coarse_x, coarse_y)
        # a coarse step of the panel is a small step in the pupil: half of it is the margin
        margin = np.max(np.abs(np.diff(pupil, axis=1)), initial=0.0) + np.max(
            np.abs(np.diff(pupil, axis=0)), initial=0.0
        )
        near = np.hypot(pupil[..., 0], pupil[..., 1]).min(axis=0) <= reach_m + margin
        for point in range(waves.count):
            if not near[:, point].any():
                continue
            low, high = coarse_x[near[:, point]][[0, -1]]
            step = coarse_x[1] - coarse_x[0] if len(coarse_x) > 1 else 0.0
            inside = np.flatnonzero((x >= low - step) & (x <= high + step))
            columns = slice(int(inside[0]), int(inside[-1]) + 1)
            yield point, _Part(waves, point, rows, columns, x[columns], y[rows], block)


def derivative(series: Series, axis: int) -> Series:
    """Return the derivative of a series along y (axis 0) or x (axis 1), per unit of the coordinates."""
    lower = np.asarray(chebyshev.chebder(series.coefficients, axis=axis) / series.half[1 - axis], np.float64)
    return replace(series, coefficients=lower)


def _phasor(phase_rad: Array) -> torch.Tensor:
    phase = torch.from_numpy(np.ascontiguousarray(phase_rad, np.float32))
    return torch.polar(torch.ones_like(phase), phase)


def _powers(base: torch.Tensor, exponents: NDArray[np.int64]) -> list[torch.Tensor]:
    """Return powers of phasors with odd or even whole exponents; a negative one is a conjugate."""
    made: dict[int, torch.Tensor] = {0: torch.ones_like(base), 1: base}
    square = base * base
    for n in range(2, int(np.max(np.abs(exponents), initial=0)) + 1):
        made[n] = square if n == 2 else made[n - 2] * square
    return [made[n] if n >= 0 else made[-n].conj().resolve_conj() for n in (int(e) for e in exponents)]
