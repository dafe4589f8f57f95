"""From an encoded field to what the panel is sent: phase, levels, packing.

Level L stands for the phase 2 pi L / 256, or for entry L of a measured response. Positive phase is delay; the field is
exp(+i phase).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from holocal.errors import InputError
from holocal.hologram.encode.blocks import in_blocks
from holocal.optics.bench import Panel
from holocal.optics.series import Series

LEVELS = 256
_FINE = 16384  # phases that a measured response is tabulated at: 1/64 of a level
_BLOCK = 32  # rows at a time: float64 work that stays in the cache


def panel_phase(field: torch.Tensor, reference_turns: Series, panel: Panel) -> NDArray[np.float32]:
    """Return the phase the panel must add, (rows, columns) float32 in [0, 2 pi).

    The encoded field's phase, plus the reference it was divided by, minus the illumination's own phase: the thesis's
    linear phase term, which puts the signal midway between orders 0 and 1.
    """
    in_y, in_x = reference_turns.bases(panel.x_m, panel.y_m)
    columns = reference_turns.coefficients @ in_x.T
    fx, fy = panel.illumination_frequency_per_m
    along_x, along_y = fx * panel.x_m, fy * panel.y_m
    values = field.cpu().numpy()
    out = np.empty((panel.height, panel.width), np.float32)

    def make(part: slice) -> None:
        turns = in_y[part] @ columns
        turns -= along_x
        turns -= along_y[part, None]
        turns -= np.floor(turns)
        # contiguous parts: numpy's arctan2 is 4 times faster on them
        angle = np.arctan2(np.ascontiguousarray(values[part].imag), np.ascontiguousarray(values[part].real))
        angle *= np.float32(0.5 / np.pi)
        angle += turns.astype(np.float32)
        angle -= np.floor(angle)
        angle *= np.float32(2 * np.pi)
        angle[angle >= np.float32(2 * np.pi)] = 0.0
        out[part] = angle

    in_blocks(make, panel.height, _BLOCK)
    return out


def phase_to_levels(phase_rad: NDArray[np.float32], response_rad: ArrayLike | None = None) -> NDArray[np.uint8]:
    """Return the nearest levels, uint8, to phases of any value.

    Parameters
    ----------
    phase_rad
        (rows, columns) radians.
    response_rad
        (2**bits,) the phase that each level really gives, 8 bits at most; default 2 pi L / 256. Distances are taken
        round the circle, and the smallest of equally good levels is chosen.
    """
    table = None if response_rad is None else _nearest_levels(response_rad)
    phases = np.atleast_2d(phase_rad)
    levels = np.empty(phases.shape, np.uint8)
    count = LEVELS if table is None else _FINE
    per_rad = phases.dtype.type(count / (2 * np.pi))

    def make(part: slice) -> None:
        steps = np.rint(phases[part] * per_rad).astype(np.int64) % count
        levels[part] = steps if table is None else table[steps]

    in_blocks(make, len(phases), _BLOCK)
    return levels.reshape(np.shape(phase_rad))


def _nearest_levels(response_rad: ArrayLike) -> NDArray[np.uint8]:
    """Return the nearest level to each of _FINE phases round the circle: one of its two neighbours on it."""
    response = np.asarray(response_rad, np.float64)
    count = response.size
    if response.ndim != 1 or not 2 <= count <= LEVELS or count & (count - 1) or not np.all(np.isfinite(response)):
        raise InputError(
            f"A phase response has a finite entry for each of 2**bits levels, {LEVELS} at most; this one has shape "
            f"{response.shape}."
        )
    place, first = np.unique(np.round(np.mod(response, 2 * np.pi), 12), return_index=True)
    around = np.concatenate([[place[-1] - 2 * np.pi], place, [place[0] + 2 * np.pi]])
    level = np.concatenate([first[-1:], first, first[:1]])
    phase = 2 * np.pi * np.arange(_FINE) / _FINE
    above = np.searchsorted(around, phase)
    below = np.maximum(above - 1, 0)
    far, near = around[above] - phase, phase - around[below]
    even = np.isclose(far, near, rtol=0.0, atol=1e-12)
    upper = np.where(even, level[above] < level[below], far < near)
    return np.asarray(np.where(upper, level[above], level[below]), np.uint8)


def pack_rgb(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the 24-bit image, (rows, columns, 3), that the thesis's panel takes: levels in red, nothing elsewhere."""
    packed = np.zeros((*levels.shape, 3), np.uint8)
    packed[..., 0] = levels
    return packed


def unpack_rgb(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the levels of a packed frame; refuse one whose green or blue is not zero."""
    if packed.dtype != np.uint8 or packed.ndim != 3 or packed.shape[2] != 3:
        raise InputError(f"A packed frame is (rows, columns, 3) of uint8; this is {packed.shape} of {packed.dtype}.")
    if packed[..., 1:].any():
        raise InputError(
            f"{int(np.sum(packed[..., 1:].any(axis=-1)))} pixels of the frame have green or blue light.",
            why="The panel reads levels from the red channel.",
            fix="Give a frame written by `holocal render`.",
        )
    return np.ascontiguousarray(packed[..., 0])
