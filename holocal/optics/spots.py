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
from functools import cached_property

import numpy as np
import torch
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from holocal.errors import SamplingError
from holocal.optics.bench import Array, Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.series import Series, fit_series
from holocal.threads import each

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

    @cached_property
    def slopes(self) -> tuple[Series, Series]:
        """The derivatives of `turns` along x and along y, turns per metre."""
        return derivative(self.turns, 1), derivative(self.turns, 0)

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
    total = torch.zeros((block, block, rows, columns), dtype=torch.complex64, device=device)
    bands = list(_bands(waves, reach_m, block))

    def add(band: int) -> None:
        for point, part in bands[band]:
            first, right, down = part.carriers(device)
            sent = torch.from_numpy((amplitude[point] * window(part.pupil())).astype(np.complex64)).to(device)
            line = first * sent
            steps = _powers(right, block)
            for j in range(block):
                for k in range(block):
                    total[j, k, part.rows, part.columns].addcmul_(line, steps[k])
                line = line * down if j + 1 < block else line

    each(add, len(bands))
    whole = total.permute(2, 0, 3, 1).reshape(rows * block, columns * block)
    return whole[: panel.height, : panel.width].contiguous()


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
    planes = field.reshape(rows, block, columns, block).permute(1, 3, 0, 2).contiguous()
    bands = list(_bands(waves, reach_m, block))
    x, y = waves.block_grid(block)
    half = block / 2 * waves.panel.pitch_m
    corner_grid = _Grid.of(sent or waves, np.append(x - half, x[-1] + half), np.append(y + half, y[-1] - half))

    def held(point: int) -> tuple[Array, NDArray[np.complex64]]:
        parts = [part for band in bands for at, part in band if at == point]
        if not parts:
            return np.zeros((0, 2)), np.zeros(0, np.complex64)
        first, last = min(part.columns.start for part in parts), max(part.columns.stop for part in parts)
        top, bottom = parts[0].rows.start, parts[-1].rows.stop
        sums = torch.zeros((bottom - top + 1, last - first + 1), dtype=torch.complex64, device=field.device)
        for part in parts:
            corners = _to_corners(planes, part)
            for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
                sums[_moved(part.rows, down - top), _moved(part.columns, right - first)] += corners[down][right]
        in_rows, in_columns = slice(top, bottom + 1), slice(first, last + 1)
        whole = _Part(waves, point, in_rows, in_columns, corner_grid, block)
        pupil, values = whole.pupil(), sums.cpu().numpy()
        if sent is not None:
            values = values * replace(whole, waves=sent).areas()
        near = np.hypot(pupil[..., 0], pupil[..., 1]) <= reach_m
        return pupil[near], values[near]

    return each(held, waves.count)


def _to_corners(planes: torch.Tensor, part: _Part) -> list[list[torch.Tensor]]:
    """Return what the blocks of a part add to their corners, [top, bottom][left, right] of (rows, columns) each.

    `planes` (block, block, rows, columns): a pixel of every block after the other. By Horner's rule, sums and sums
    weighted by the pixel's number at once.
    """
    block = part.block
    first, right, down = (one.conj().resolve_conj() for one in part.carriers(str(planes.device)))
    here = planes[:, :, part.rows, part.columns]
    lines = [_moments([here[j, k] for k in range(block)], right) for j in range(block)]
    whole, to_bottom = _moments([line[0] for line in lines], down)
    of_right, of_both = _moments([line[1] for line in lines], down)
    corners = [[whole - of_right - to_bottom + of_both, of_right - of_both], [to_bottom - of_both, of_both]]
    return [[one * first for one in line] for line in corners]


def _moments(values: list[torch.Tensor], step: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return sum_k v_k step^k, and the same with each weighted by (k + 1/2) / n, its share for the farther corner."""
    total, slope = values[-1], torch.zeros_like(values[-1])
    for value in reversed(values[:-1]):
        slope = torch.addcmul(total, slope, step)
        total = torch.addcmul(value, total, step)
    return total, (slope * step + 0.5 * total) / len(values)


def _moved(part: slice, by: int) -> slice:
    return slice(part.start + by, part.stop + by)


@dataclass(frozen=True)
class _Grid:
    """Chebyshev polynomials at x (columns, terms) and y (rows, terms): what a series of a wave needs on this grid."""

    in_x: Array
    in_y: Array

    @classmethod
    def of(cls, waves: SpotWaves, x_m: Array, y_m: Array) -> _Grid:
        """Return the tables for the series of waves."""
        series = waves.turns
        rows, columns = np.maximum(series.coefficients.shape[:2], waves.pupil.coefficients.shape[:2])
        in_x = chebyshev.chebvander((x_m - series.centre[0]) / series.half[0], int(columns) - 1)
        in_y = chebyshev.chebvander((y_m - series.centre[1]) / series.half[1], int(rows) - 1)
        return cls(np.asarray(in_x, np.float64), np.asarray(in_y, np.float64))

    def at(self, coefficients: Array, rows: slice, columns: slice) -> Array:
        """Return the values (rows, columns) of a series with coefficients (terms in y, terms in x)."""
        of_y, of_x = coefficients.shape
        return np.asarray(self.in_y[rows, :of_y] @ (coefficients @ self.in_x[columns, :of_x].T))


@dataclass(frozen=True)
class _Part:
    """A point's wave over a rectangle of blocks."""

    waves: SpotWaves
    point: int
    rows: slice
    columns: slice
    grid: _Grid
    block: int

    def pupil(self) -> Array:
        """Return q of the blocks' centres, (rows, columns, 2)."""
        return np.stack([self._at(self.waves.pupil.coefficients[..., axis]) for axis in (0, 1)], axis=-1)

    def areas(self) -> NDArray[np.float32]:
        """Return what a pixel's area sends of the wave, (rows, columns), 1 for light that is not turned."""
        panel = self.waves.panel
        made = np.ones((1, 1), np.float32)
        for series, own in zip(self.waves.slopes, panel.illumination_frequency_per_m, strict=True):
            turned = (self._at(series.coefficients) - own) * panel.pitch_m
            made = made * torch.sinc(torch.from_numpy(turned.astype(np.float32))).numpy()
        return made

    def carriers(self, device: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the wave at the blocks' first pixels (top left), and its factors for a pixel to the right and down."""
        pitch = self.waves.panel.pitch_m
        right, up = (pitch * self._at(series.coefficients) for series in self.waves.slopes)
        first = self._at(self.waves.turns.coefficients) - (self.block - 1) / 2 * (right - up)
        phasors = (_phasor(2 * np.pi * (one - np.round(one))) for one in (first, right, -up))  # rows run down, y up
        first_there, right_there, down_there = (one.to(device) for one in phasors)
        return first_there, right_there, down_there

    def _at(self, coefficients: Array) -> Array:
        return self.grid.at(coefficients[:, :, self.point], self.rows, self.columns)


def _bands(waves: SpotWaves, reach_m: float, block: int) -> Iterator[list[tuple[int, _Part]]]:
    """Yield the waves of a band of blocks, each cut to where its light crosses the pupil within reach."""
    x, y = waves.block_grid(block)
    grid = _Grid.of(waves, x, y)
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
        band = []
        for point in range(waves.count):
            if not near[:, point].any():
                continue
            low, high = coarse_x[near[:, point]][[0, -1]]
            step = coarse_x[1] - coarse_x[0] if len(coarse_x) > 1 else 0.0
            inside = np.flatnonzero((x >= low - step) & (x <= high + step))
            band.append((point, _Part(waves, point, rows, slice(int(inside[0]), int(inside[-1]) + 1), grid, block)))
        if band:
            yield band


def derivative(series: Series, axis: int) -> Series:
    """Return the derivative of a series along y (axis 0) or x (axis 1), per unit of the coordinates."""
    lower = np.asarray(chebyshev.chebder(series.coefficients, axis=axis) / series.half[1 - axis], np.float64)
    return replace(series, coefficients=lower)


def _phasor(phase_rad: Array) -> torch.Tensor:
    phase = torch.from_numpy(np.ascontiguousarray(phase_rad, np.float32))
    return torch.polar(torch.ones_like(phase), phase)


def _powers(base: torch.Tensor, count: int) -> list[torch.Tensor]:
    """Return the powers 0 to count - 1."""
    made = [torch.ones_like(base)]
    for _ in range(count - 1):
        made.append(made[-1] * base)
    return made
