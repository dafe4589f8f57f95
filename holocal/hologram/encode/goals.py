"""What an encoder descends to: a set of spectra that are as good as each other, and the way to the nearest of them.

| goal | good is | measured as |
|---|---|---|
| `FieldGoal` | the wanted field times any real scale | complex error in the window |
| `ModulusGoal` | its modulus, any phase | what is asked for when the window is the image itself |
| `CameraGoal` | its intensity averaged over each image pixel | what a camera of that many pixels sees |

Half the squared distance to such a set has the gradient "spectrum less nearest good one" and, seen through a transform of
norm 1, a curvature of at most 1: a step of 1 never rises (for `CameraGoal` too, since its distance is at most that to
the wanted amplitude along the present direction).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from holocal.hologram.encode.encoder import Misfit, power, window_misfit

_TINY = 1e-20


class Goal(Protocol):
    """Says how far a spectrum is from good."""

    def misfit(self, found: torch.Tensor, wanted: torch.Tensor, signal: float | None) -> Misfit:
        """Return what is too much in a compact spectrum, whose memory may be used.

        Parameters
        ----------
        found, wanted
            Compact spectra, zero outside the window.
        signal
            The power that the nearest good spectrum shall have; None: whatever fits best.
        """


@dataclass(frozen=True)
class FieldGoal:
    """The wanted field itself, scaled: what holocal asks for in the pupil."""

    def misfit(self, found: torch.Tensor, wanted: torch.Tensor, signal: float | None) -> Misfit:
        """Return found - s wanted."""
        return window_misfit(found, wanted, signal)


@dataclass(frozen=True)
class ModulusGoal:
    """The wanted field's modulus with the phase that is there: Gerchberg and Saxton's constraint."""

    def misfit(self, found: torch.Tensor, wanted: torch.Tensor, signal: float | None) -> Misfit:
        """Return found - s |wanted| found / |found|."""
        inside, there, asked = power(found), found.abs(), wanted.abs()
        scale = _scale(there, asked, signal)
        asked.mul_(-scale).add_(there).div_(there.clamp_(min=_TINY))
        return Misfit(found.mul_(asked), scale**2 * power(wanted), inside)


@dataclass(frozen=True)
class CameraGoal:
    """The image's intensity averaged over each of its pixels, in a spectrum that is the image, two samples per pixel.

    The compact spectrum is a `FarField(finer=2, margin=1)`'s: (2 rows + 2, 2 columns + 2), in the image's order. What is
    asked of a pixel is the root of the sum of |wanted|^2 over its own four samples. Two samples per pixel hold an
    intensity's whole band; the weights (tail, half, half, tail) of four of them give its mean over a pixel.
    """

    # For every lag of the field's correlation within 0.02 of the mean of 4 finer samples, 0.02 of the integral at
    # most; (0, 0.5, 0.5, 0) is 0.07 off and stops at 42 dB, these weights at 54 dB (test_encoders, quality.py).
    tail: float = 0.019

    def misfit(self, found: torch.Tensor, wanted: torch.Tensor, signal: float | None) -> Misfit:
        """Return found times the excess of its pixels' amplitudes, shared as the weights say."""
        asked = pixel_amplitude(wanted, 0.0)
        seen = pixel_amplitude(found, self.tail)
        scale = _scale(seen, asked, signal)
        short = asked * -scale
        inside = power(found)
        short.add_(seen)
        error = power(short)
        factor = short.div_(seen.clamp_(min=_TINY))
        for axis in (0, 1):
            factor = _shared(factor, self.tail, axis).mul_(2)
        return CameraMisfit(found.mul_(factor), scale**2 * power(asked), inside, error)


@dataclass(frozen=True)
class CameraMisfit(Misfit):
    """A misfit whose squared error is not its excess's power: a pixel's samples differ."""

    squared: float

    @property
    def error(self) -> float:
        """Return the rms error of the amplitudes over their rms."""
        return float((self.squared / max(self.signal, _TINY)) ** 0.5)


def pixel_amplitude(spectrum: torch.Tensor, tail: float) -> torch.Tensor:
    """Return the root of each pixel's light, (rows, columns), from two samples per pixel and one more on each side."""
    parts = torch.view_as_real(spectrum)
    light = parts.square().sum(dim=-1)
    for axis in (0, 1):
        light = _gathered(light, tail, axis).mul_(2)
    return light.sqrt_()


def _weights(tail: float) -> tuple[float, ...]:
    return (tail, 0.5 - tail, 0.5 - tail, tail)


def _gathered(samples: torch.Tensor, tail: float, axis: int) -> torch.Tensor:
    """Return for pixel p the weighted samples 2 p .. 2 p + 3 along an axis."""
    last = samples.shape[axis] - 3
    out = torch.zeros(())
    for first, weight in enumerate(_weights(tail)):
        part = samples.narrow(axis, first, last)
        out = out + weight * (part[::2] if axis == 0 else part[:, ::2])
    return out


def _shared(pixels: torch.Tensor, tail: float, axis: int) -> torch.Tensor:
    """Return the adjoint of `_gathered`."""
    shape = list(pixels.shape)
    shape[axis] = 2 * shape[axis] + 2
    out = torch.zeros(shape, dtype=pixels.dtype, device=pixels.device)
    for first, weight in enumerate(_weights(tail)):
        part = out.narrow(axis, first, shape[axis] - 3)
        (part[::2] if axis == 0 else part[:, ::2]).add_(pixels, alpha=weight)
    return out


def _scale(seen: torch.Tensor, asked: torch.Tensor, signal: float | None) -> float:
    full = max(power(asked), 1e-30)
    if signal is not None:
        return float((signal / full) ** 0.5)
    return float(torch.sum(seen * asked)) / full
