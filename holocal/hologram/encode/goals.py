"""What an encoder descends to: a set of spectra that are as good as each other, and the way to the nearest of them.

| goal | good is | measured as |
|---|---|---|
| `FieldGoal` | the wanted field times any real scale | complex error in the window |
| `ModulusGoal` | its modulus, any phase | what is asked for when the window is the image itself |
| `CameraGoal` | its intensity averaged over each image pixel | what a camera of that many pixels sees |

Half the squared distance to such a set has the gradient "spectrum less nearest good one" and, seen through a transform
of norm 1, a curvature of at most 1: a step of 1 never rises (for `CameraGoal` too, since its distance is at most that
to the wanted amplitude along the present direction).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from holocal.hologram.encode.encoder import Misfit, power, relative, window_misfit

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
        inside, there = power(found), found.abs()
        factor, squared, power_asked = _too_bright(there, wanted.abs(), signal)
        return Misfit(found.mul_(factor), squared, power_asked, inside)


@dataclass(frozen=True)
class CameraGoal:
    """The image's intensity averaged over each of its pixels, in a spectrum that is the image, two samples per pixel.

    The most exact for a camera whose pixels are the image's; one that is half a pixel off sees the speckle that the
    averages hide (quality.py: 53 dB and 17 dB from a random phase). `ModulusGoal` on the same grid serves both.

    The compact spectrum is a `FarField(finer=2, margin=1)`'s: (2 rows + 2, 2 columns + 2), in the image's order. What
    is asked of a pixel is the root of the sum of |wanted|^2 over its own four samples. Two samples per pixel hold an
    intensity's whole band; four of them, weighted (tail, 1/2 - tail, 1/2 - tail, tail), give its mean over a pixel.
    """

    # For every lag of the field's correlation within 0.02 of the mean of 4 finer samples, 0.02 of the integral at
    # most; (0, 0.5, 0.5, 0) is 0.07 off and stops at 42 dB, these weights at 54 dB (test_encoders, quality.py).
    tail: float = 0.019

    def misfit(self, found: torch.Tensor, wanted: torch.Tensor, signal: float | None) -> Misfit:
        """Return found times the excess of its pixels' amplitudes, shared as the weights say."""
        inside, seen = power(found), pixel_amplitude(found, self.tail)
        factor, squared, power_asked = _too_bright(seen, pixel_amplitude(wanted, 0.0), signal)
        for axis in (0, 1):
            factor = _shared(factor, self.tail, axis).mul_(2)
        return Misfit(found.mul_(factor), squared, power_asked, inside)


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


def _too_bright(seen: torch.Tensor, asked: torch.Tensor, signal: float | None) -> tuple[torch.Tensor, float, float]:
    """Return (seen - s asked) / seen, the error's power, and the power asked for; s as in `window_misfit`."""
    full = max(power(asked), 1e-30)
    scale = float(torch.sum(seen * asked)) / full if signal is None else (signal / full) ** 0.5
    short = torch.add(seen, asked, alpha=-scale)
    squared, given = power(short), scale * scale * full
    if signal is None:
        short.sub_(asked, alpha=scale * relative(squared, given) if scale else 0.0)
    return short.div_(seen.clamp(min=_TINY)), squared, given
