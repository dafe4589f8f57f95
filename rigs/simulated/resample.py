"""Coarse samples brought to a fine grid on carriers of their own, and summed there: small matrix products.

A piece of the field is band-limited around a carrier, exp(i c(x)) along the fine grid. A polyphase filter times that
carrier is one small matrix per block of fine samples, and adding the pieces is what a matrix product does anyway.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array
from rigs.simulated.pupil import unit_phase

TAPS = 14  # of the filter, per fine sample
OVERSAMPLING = 1.4  # of coarse samples, against the piece's bandwidth: 14 taps then leave 1e-3
STEP = 2  # coarse samples per block: the ratio of fine to coarse is half a whole number, and the blocks are larger


@dataclass(frozen=True)
class Resampling:
    """Coarse samples `fine_m` are made from: `per_block` of these for every `STEP` of those.

    `share` is the piece's bandwidth as a share of the coarse sampling rate.
    """

    fine_m: Array
    per_block: int
    share: float

    @classmethod
    def of(cls, fine_m: Array, critical_m: float) -> Resampling:
        """Return the coarsest samples that oversample pieces whose critical distance is `critical_m`."""
        pitch = float(fine_m[1] - fine_m[0])
        per_block = max(STEP, int(STEP * critical_m / OVERSAMPLING / pitch))
        return cls(fine_m, per_block, per_block * pitch / STEP / critical_m)

    @property
    def blocks(self) -> int:
        """How many blocks of fine samples there are; the last may end beyond them."""
        return -(-len(self.fine_m) // self.per_block)

    @property
    def pitch_m(self) -> float:
        """Distance of the coarse samples."""
        return float(self.fine_m[1] - self.fine_m[0]) * self.per_block / STEP

    @cached_property
    def coarse_m(self) -> Array:
        """Places of the coarse samples, ascending."""
        first = self.fine_m[0] - (TAPS // 2 - 1) * self.pitch_m
        return np.asarray(first + np.arange(self.blocks * STEP + TAPS - 1) * self.pitch_m)

    @cached_property
    def taps(self) -> NDArray[np.float32]:
        """The filter, (per_block, TAPS): a Kaiser-windowed sinc."""
        at = np.arange(self.per_block)[:, None] * STEP / self.per_block
        offset = np.arange(TAPS + STEP - 1) - (TAPS // 2 - 1) - at
        within = np.maximum(0.0, 1 - (offset / (TAPS / 2)) ** 2)
        taps = np.sinc(offset)
        if self.per_block > STEP:  # else the samples are the fine ones already
            taps *= np.i0(self._beta * np.sqrt(within)) * (within > 0)
        return np.asarray(taps / taps.sum(axis=1, keepdims=True), np.float32)

    @property
    def _beta(self) -> float:
        attenuation = 2.285 * (TAPS - 1) * 2 * np.pi * (1 - self.share) + 7.95
        return float(0.1102 * (attenuation - 8.7) if attenuation > 50 else 0.5842 * (attenuation - 21) ** 0.4)

    def matrices(self, carrier_rad: Array) -> torch.Tensor:
        """Return (blocks, per_block, taps) complex64: the filter times exp(i carrier) of the fine samples."""
        padded = np.zeros(self.blocks * self.per_block, np.complex64)
        padded[: len(carrier_rad)] = unit_phase(carrier_rad)
        return torch.from_numpy(padded.reshape(self.blocks, self.per_block, 1) * self.taps)


def add_piece(piece: torch.Tensor, matrix: torch.Tensor, *, out: torch.Tensor, first: bool) -> None:
    """Add a piece, (its coarse samples, m), to the fine grid `out` (fine samples or more, m), or begin `out` with it.

    `out` has at least the rows of the piece's blocks; what is beyond the fine grid is not defined.
    """
    (blocks, per_block, taps), m = matrix.shape, out.shape[1]
    windows = piece.unfold(0, taps, STEP).transpose(1, 2)  # (blocks, taps, m), a view
    part = out[: blocks * per_block].view(blocks, per_block, m)
    torch.baddbmm(part, matrix, windows, beta=0 if first else 1, out=part)


def transposed(array: torch.Tensor) -> torch.Tensor:
    """Return a complex64 matrix, rows and columns exchanged, as a new one: ten times as fast as a strided copy."""
    pairs = torch.view_as_real(array).numpy()
    return torch.view_as_complex(torch.from_numpy(cv2.transpose(pairs)))
