"""Error diffusion of a complex field: what a pixel cannot show, its neighbours make up for (thesis 3.1).

u = g / |g| with g = s h + sum_k w_k e_k over the neighbours before it, e = g - u. Then u = s h - (e - sum w_k e_k): the
error appears in the spectrum multiplied by 1 - W(f), W(f) = sum_k w_k exp(-2 pi i f.k), a factor that the weights make
small where the window is. Floyd & Steinberg's four weights do so round f = 0; `for_window` fits more to the window.

Pixel (r, c) is done at step t = c + skew r, when all it needs is done: every step is one array operation over up to
columns / skew rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from holocal.hologram.encode.encoder import Target, assess, in_window
from holocal.hologram.encode.ifta import Encoded
from holocal.hologram.encode.levels import Levels

_TINY = np.float32(1e-20)


@dataclass(frozen=True)
class Weights:
    """How much of the error of the pixel `down` rows above and `right` columns to the left a pixel takes over.

    `rows[down]` holds the weights of right = -reach..reach; of row 0 those with right > 0 count.

    Examples
    --------
    >>> FLOYD_STEINBERG.table()[1]
    array([0.1875, 0.3125, 0.0625], dtype=float32)
    """

    rows: tuple[tuple[float, ...], ...]

    @property
    def reach(self) -> int:
        """Return the largest distance along a row."""
        return len(self.rows[0]) // 2

    def table(self) -> NDArray[np.float32]:
        """Return the weights (down, right + reach), those of pixels not done yet 0."""
        table = np.array(self.rows, np.float32)
        table[0, : self.reach + 1] = 0
        return table


FLOYD_STEINBERG = Weights(((0, 0, 7 / 16), (3 / 16, 5 / 16, 1 / 16)))


def for_window(target: Target, *, reach: int = 3, depth: int = 3, damping: float = 0.05) -> Weights:
    """Return the weights that leave the least of a white error in the window.

    They minimise sum over the window of |1 - W(f)|^2, plus `damping` times the window's bins times sum w^2: a linear
    prediction of the window's own autocorrelation. Less damping, deeper in the window but errors that grow on their
    way: 0.05 leaves an error of 0.10 at 4K, 0.003 lets it grow without bound (reach and depth 3).
    """
    places = [(down, right) for down in range(depth + 1) for right in range(-reach, reach + 1) if down or right > 0]
    down, right = np.array(places).T
    fx, fy = target.transform.frequencies(1.0, 1.0)
    mask = target.window.cpu().numpy().astype(np.float64)
    span_y, span_x = np.arange(-depth, depth + 1), np.arange(-2 * reach, 2 * reach + 1)
    along = np.exp(-2j * np.pi * span_y[:, None] * fy) @ mask @ np.exp(2j * np.pi * fx[:, None] * span_x)
    kernel = along.real / max(mask.sum(), 1.0)
    matrix = kernel[down[:, None] - down + depth, right[:, None] - right + 2 * reach]
    found = np.linalg.solve(matrix + damping * np.eye(len(places)), kernel[down + depth, right + 2 * reach])
    table = np.zeros((depth + 1, 2 * reach + 1))
    table[down, right + reach] = found
    return Weights(tuple(tuple(float(weight) for weight in row) for row in table))


@dataclass(frozen=True)
class ErrorDiffusion:
    """One pass over the panel, on the CPU.

    Parameters
    ----------
    light
        The share of the panel's light that the hologram is scaled to, mean(|s h|^2); less is more exact.
    weights
        Who passes how much on to whom; None fits them to the window.
    levels
        The phases that the panel has; None for any.
    """

    light: float = 0.3
    weights: Weights | None = None
    levels: Levels | None = None

    def __call__(self, target: Target) -> Encoded:
        """Return the diffused field."""
        weights = self.weights or for_window(target)
        hologram = in_window(target, self.light).cpu()
        field = diffused(hologram, weights, self.levels)
        return assess(field.to(target.start.device), target)


def diffused(hologram: torch.Tensor, weights: Weights, levels: Levels | None = None) -> torch.Tensor:
    """Return the phasors of a hologram (rows, columns) complex64 whose modulus is mostly below 1; in its memory."""
    work = _Work.of(hologram.contiguous().numpy(), weights)
    beside = None if levels is None or levels.beside_rad is None else levels.beside_rad.cpu().numpy()
    for step in range(work.steps):
        chosen, part = work.asked(step)
        work.settle(step, part, _phasors(chosen, work, part, levels, beside, step))
    return torch.from_numpy(work.pixels.reshape(hologram.shape))


@dataclass
class _Work:
    """Buffers of a pass: the pixels, read and overwritten along skewed diagonals, and a ring of errors.

    `errors` holds line t of e(t, r) twice, `lines` apart, so that the lines that a step needs are always consecutive:
    one product with the weights per row distance. Lines have `margin` zeros before row 0.
    """

    pixels: NDArray[np.complex64]  # flat
    rows: int
    columns: int
    skew: int
    taps: list[tuple[int, int, NDArray[np.float32]]]  # row distance, last line's distance, weights from the oldest
    errors: NDArray[np.float32]
    lines: int
    margin: int
    scratch: tuple[NDArray[np.complex64], ...]
    modulus: NDArray[np.float32]

    @classmethod
    def of(cls, hologram: NDArray[np.complex64], weights: Weights) -> _Work:
        rows, columns = hologram.shape
        table, reach = weights.table(), weights.reach
        depth, skew = len(table) - 1, reach + 1
        taps = []
        for down, line in enumerate(table):
            used = np.flatnonzero(line)
            if len(used):  # right = used - reach, so the error's line is right + skew down back
                first, last = used[0], used[-1]
                oldest_first = np.ascontiguousarray(line[first : last + 1][::-1])
                taps.append((down, int(first - reach + skew * down), oldest_first))
        lines = skew * depth + reach + 1
        errors = np.zeros((2 * lines, 2 * (rows + depth)), np.float32)
        scratch = tuple(np.zeros(rows, np.complex64) for _ in range(3))
        modulus = np.empty(rows, np.float32)
        return cls(hologram.reshape(-1), rows, columns, skew, taps, errors, lines, depth, scratch, modulus)

    @property
    def steps(self) -> int:
        """Return how many diagonals there are."""
        return self.columns + self.skew * (self.rows - 1) if self.columns else 0

    def asked(self, step: int) -> tuple[NDArray[np.complex64], slice]:
        """Return g of a diagonal, and its rows."""
        first = max(0, -((self.columns - 1 - step) // self.skew))
        part = slice(first, max(first, min(self.rows, step // self.skew + 1)))  # empty now and then on a narrow panel
        value, product = self.scratch[0][part], self.scratch[1][part].view(np.float32)
        np.copyto(value, self.diagonal(step, part))
        parts = value.view(np.float32)
        newest = step % self.lines + self.lines  # the line of this step, in the second copy
        for down, back, weights in self.taps:
            left, right = 2 * (part.start - down + self.margin), 2 * (part.stop - down + self.margin)
            end = newest - back + 1
            np.dot(weights, self.errors[end - len(weights) : end, left:right], out=product)
            np.add(parts, product, out=parts)
        return value, part

    def diagonal(self, step: int, part: slice) -> NDArray[np.complex64]:
        """Return the pixels (r, step - skew r) of some rows, a view."""
        start = part.start * self.columns + step - self.skew * part.start
        stride = max(self.columns - self.skew, 1)  # a panel as narrow as the skew has one pixel per diagonal
        return self.pixels[start : max(start, start + stride * (part.stop - part.start - 1) + 1) : stride]

    def settle(self, step: int, part: slice, phasors: NDArray[np.complex64]) -> None:
        """Write a diagonal's phasors and the error that they make."""
        np.copyto(self.diagonal(step, part), phasors)
        value = self.scratch[0][part]
        np.subtract(value, phasors, out=value)
        parts = value.view(np.float32)
        left, right = 2 * (part.start + self.margin), 2 * (part.stop + self.margin)
        for line in (step % self.lines, step % self.lines + self.lines):
            whole = self.errors[line]
            whole[:left], whole[right:] = 0, 0
            whole[left:right] = parts


def _phasors(
    value: NDArray[np.complex64],
    work: _Work,
    part: slice,
    levels: Levels | None,
    beside: NDArray[np.float32] | None,
    step: int,
) -> NDArray[np.complex64]:
    """Return g / |g|, or the level nearest to it; 1 for 0."""
    out, modulus = work.scratch[2][part], work.modulus[part]
    if levels is not None:
        rows = np.arange(part.start, part.stop)
        turn: Any = 2 * np.pi / levels.count
        offset = 0.0 if beside is None else beside[rows, step - work.skew * rows]
        phase = np.rint((np.angle(value) + offset) / turn) * turn - offset
        out.real, out.imag = np.cos(phase), np.sin(phase)
        return out
    np.abs(value, out=modulus)
    if modulus.size and modulus.min() < _TINY:
        dark = modulus < _TINY
        value = np.where(dark, np.complex64(1), value)
        modulus[dark] = 1
    np.reciprocal(modulus, out=modulus)
    out.real, out.imag = modulus, 0
    np.multiply(value, out, out=out)
    return out
