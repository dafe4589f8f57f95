"""The plain Fourier hologram: a square panel whose far field, in a window round the axis, is the image.

A panel of N pixels has N far-field samples across; an image pixel is one of them wide. What lies between the samples
follows from zero padding, and a camera sees it too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.fft
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array

_WORKERS = 2


@dataclass
class FarField:
    """The orthonormal Fourier transform of a field, `finer` samples per image pixel, within the image.

    Parameters
    ----------
    rows, columns
        Of the field.
    image
        (rows, columns) of the image in pixels, at most the field's; pixel n // 2 is on the axis.
    finer
        Samples per image pixel along each axis; sample m of pixel p lies at p + (m + 1/2) / finer - 1/2.
    margin
        Samples beside the image, on each side.

    A spectrum is in the image's order, (finer rows + 2 margin, finer columns + 2 margin), and is scaled so that the
    norm of the transform is 1 and light is conserved whatever `finer` is.
    """

    rows: int
    columns: int
    image: tuple[int, int]
    finer: int = 1
    margin: int = 0
    _ramps: tuple[NDArray[np.complex64], NDArray[np.complex64]] = field(init=False, repr=False)
    _bins: tuple[NDArray[np.int64], NDArray[np.int64]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        shift = 0.5 / self.finer - 0.5
        sizes = (self.rows, self.columns)
        ramps = [np.exp(-2j * np.pi * shift * np.arange(size) / size).astype(np.complex64) for size in sizes]
        self._ramps = (ramps[0], ramps[1])
        lines = [self._lines(pixels) % (self.finer * size) for pixels, size in zip(self.image, sizes, strict=True)]
        self._bins = (lines[0], lines[1])

    def _lines(self, pixels: int) -> NDArray[np.int64]:
        first = -(pixels // 2) * self.finer - self.margin
        return np.arange(first, first + pixels * self.finer + 2 * self.margin)

    def frequencies(self, step_x_m: float, step_y_m: float) -> tuple[Array, Array]:
        """Return fx and fy of a spectrum's columns and rows, cycles per metre; +fy is up, rows run down."""
        shift = 0.5 / self.finer - 0.5
        fy, fx = (self._lines(pixels) / self.finer + shift for pixels in self.image)
        return fx / (self.columns * step_x_m), -fy / (self.rows * step_y_m)

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the spectrum of a field; the field is kept. Only the lines that matter are transformed."""
        options: Any = {"norm": "ortho", "workers": _WORKERS, "overwrite_x": True}
        ramp_y, ramp_x = self._ramps
        bins_y, bins_x = self._bins
        half = scipy.fft.fft(data.numpy() * ramp_x, n=self.finer * self.columns, axis=1, **options)[:, bins_x]
        half *= ramp_y[:, None]
        return torch.from_numpy(scipy.fft.fft(half, n=self.finer * self.rows, axis=0, **options)[bins_y])

    def adjoint(self, compact: torch.Tensor) -> torch.Tensor:
        """Return the field of a spectrum."""
        options: Any = {"norm": "ortho", "workers": _WORKERS, "overwrite_x": True}
        ramp_y, ramp_x = self._ramps
        bins_y, bins_x = self._bins
        tall = np.zeros((self.finer * self.rows, len(bins_x)), np.complex64)
        tall[bins_y] = compact.numpy()
        tall = scipy.fft.ifft(tall, axis=0, **options)[: self.rows] * ramp_y.conj()[:, None]
        wide = np.zeros((self.rows, self.finer * self.columns), np.complex64)
        wide[:, bins_x] = tall
        out = scipy.fft.ifft(wide, axis=1, **options)[:, : self.columns] * ramp_x.conj()
        return torch.from_numpy(np.ascontiguousarray(out))
