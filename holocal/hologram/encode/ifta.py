"""Phase-only encoding by the iterative Fourier transform algorithm (thesis 3.1; 10 iterations).

On the panel the modulus is 1. In the pupil's plane, the Fourier transform of the field divided by the reference, the
wanted field stands inside the signal window (the pupil); outside it, where no eye looks, the field is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from holocal.hologram.encode.blocks import block_length, in_blocks, lines
from holocal.hologram.encode.fourier import WindowedTransform


_TINY = 1e-30


@dataclass(frozen=True)
class Encoded:
    """A field of unit modulus and how well it does.

    `field` (rows, columns) complex64; `efficiency` is the share of its light that is wanted signal: in the window and
    in proportion to the wanted field; `in_window` the share in the window; `signal_error` after each iteration,
    starting with the hologram's own phase: rms error over rms of the scaled wanted field, inside the window.
    """

    field: torch.Tensor
    efficiency: float
    in_window: float
    signal_error: tuple[float, ...]


def unit_modulus(field: torch.Tensor) -> torch.Tensor:
    """Divide a complex field by its modulus in place, and return it; 0 stays 0."""
    if field.device.type != "cpu":
        parts = torch.view_as_real(field)
        parts.div_(torch.linalg.vector_norm(parts, dim=-1, keepdim=True).clamp_(min=_TINY))
        return field
    values = field.numpy()
    factor = np.abs(values)  # vectorised: 2.9 ms per 4K frame, torch's 36
    np.maximum(factor, _TINY, out=factor)
    np.divide(np.float32(1), factor, out=factor)
    for part in (values.real, values.imag):
        part *= factor
    return field


def ifta(
    start: torch.Tensor, wanted: torch.Tensor, window: torch.Tensor, transform: WindowedTransform, *, iterations: int,
    relax: float = 1.0, beta: float = 0.0, floor: float = 0.0) -> Encoded:
    field, target = start, _Target(wanted, window, floor)
    height = block_length(field.shape[1], len(field), transform.device)
    in_blocks(lambda part: unit_modulus(field[part]), len(field), height)
    errors, signal, inside = [], 0.0, 0.0
    found = transform.forward(field)
    velocity = None
    for step in range(iterations + 1):
        scale, inside = target.fit(found)
        signal = scale**2 * target.power
        errors.append(max(inside / max(signal, 1e-30) - 1, 0.0) ** 0.5)
        if step < iterations:
            lack = target.lack(found, scale)
            if beta:
                velocity = lack*relax if velocity is None else velocity.mul_(beta).add_(lack, alpha=relax)
                lack = velocity
            elif relax != 1:
                lack = lack * relax
            found = transform.update(field, lack, unit_modulus)
    return Encoded(field, signal / field.numel(), inside / field.numel(), tuple(errors))

class _Target:
    def __init__(self, wanted, window, floor=0.0):
        self.wanted = lines(wanted * window)
        self.outside = lines(~window)
        self.floor=floor
        self.device = wanted.device.type
        self.power = 0.0
        self.power = max(self.sums(self.wanted, clear=False)[1], 1e-30)

    def sums(self, found, clear=True):
        rows, columns = found.shape
        sums = np.zeros((rows, 2))
        def work(part):
            f = found[part]
            if clear:
                f[self.outside[part]] = 0
            w = self.wanted[part]
            if isinstance(f, torch.Tensor):
                f, w = (torch.view_as_real(x).flatten(1) for x in (f, w))
                sums[part, 0] = torch.linalg.vecdot(w, f).cpu().numpy()
                sums[part, 1] = torch.linalg.vecdot(f, f).cpu().numpy()
            else:
                f, w = f.view("f4"), w.view("f4")
                sums[part, 0] = np.vecdot(w, f)
                sums[part, 1] = np.vecdot(f, f)
        in_blocks(work, rows, block_length(columns, rows, self.device))
        return [float(x) for x in sums.sum(0)]

    def fit(self, found):
        cross, power = self.sums(lines(found))
        s = cross / self.power
        return max(s, self.floor * (power / self.power) ** 0.5), power

    def lack(self, found, scale):
        f = lines(found)
        rows, columns = f.shape
        def work(part):
            f[part] *= -1
            f[part] += self.wanted[part] * scale
        in_blocks(work, rows, block_length(columns, rows, self.device))
        return found
