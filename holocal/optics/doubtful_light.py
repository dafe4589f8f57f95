"""Light whose way the samples of a field do not tell: a warning with the share of it."""

from __future__ import annotations

import warnings
from math import sqrt

import numpy as np
import scipy.fft
import torch

from holocal.errors import SamplingWarning
from holocal.optics.bench import Array
from holocal.optics.free_space_kernel import padded_size, sampled_in_space, switch_distance

DOUBTFUL_SHARE = 1e-4  # of the power: 1 % of the field


def warn_of_doubtful_light(
    field: torch.Tensor, steps: tuple[float, float], *, wavelength_m: float, distance_m: float
) -> None:
    """Warn, in the name of the caller's caller, where the field's samples do not say where its light goes.

    That can only be nearer than an axis's switch. Beyond it the other orders of the pixels miss the window.

    Parameters
    ----------
    field
        (..., rows, columns); of several, the worst one counts.
    steps
        Pitch (y, x), metres.
    """
    z = abs(distance_m)
    in_space = sampled_in_space(field.shape, steps, wavelength_m=wavelength_m, distance_m=z)
    for axis in (axis for axis in (0, 1) if not in_space[axis]):
        n, step = int(field.shape[axis - 2]), steps[axis]
        nearest = switch_distance(n, pitch_m=step, wavelength_m=wavelength_m)
        if 2 * step <= wavelength_m:
            cycles = step / wavelength_m
            doubt = "is evanescent: it is dropped, and some of it would arrive"
            cure = "Use"
        else:
            # Order 1 of the pixels is as good a reading of the samples as order 0, and falls into the window when its
            # sine, wavelength / pitch less its own, is below that of the window's far corner.
            sine = n * step / sqrt((n * step) ** 2 + z * z)
            cycles = max(0.45, 1 - sine * step / wavelength_m)
            doubt = f"is within {1 - 2 * cycles:.1%} of the sampling limit: what is between the samples decides its way"
            cure = "Sample finer, soften the edges over two pixels, or use"
        share = _share_beyond(field, axis - 2, cycles)
        if share > DOUBTFUL_SHARE:
            warnings.warn(
                f"{share:.1e} of the power along {'yx'[axis]} ({n} pixels of {step:.3g} m) {doubt} at {z:.3g} m; the "
                f"limit is {DOUBTFUL_SHARE:.0e} of the power. {cure} more than {nearest:.3g} m.",
                SamplingWarning,
                stacklevel=3,
            )


def _share_beyond(field: torch.Tensor, axis: int, cycles: float) -> float:
    """Return the largest share, over the fields, of the power beyond a frequency (cycles per pixel) along one axis."""
    size = padded_size(int(field.shape[axis]))
    first = int(np.ceil(cycles * size))
    worst = 0.0
    for one in field.detach().reshape(-1, *field.shape[-2:]):
        spectrum = scipy.fft.fft(one.resolve_conj().cpu().numpy(), size, axis=axis, workers=torch.get_num_threads())
        power: Array = np.sum(np.abs(spectrum) ** 2, axis=-3 - axis, dtype=np.float64)
        if power.any():
            worst = max(worst, float(power[first : size - first + 1].sum() / power.sum()))
    return worst
