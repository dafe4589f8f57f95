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
_AXES = (("y", "rows"), ("x", "columns"))


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
    for axis, in_space in enumerate(sampled_in_space(field.shape, steps, wavelength_m=wavelength_m, distance_m=z)):
        if in_space:
            continue
        n, step = int(field.shape[axis - 2]), steps[axis]
        name, lines = _AXES[axis]
        if 2 * step <= wavelength_m:
            share = _share_beyond(field, axis - 2, step / wavelength_m)
            if share > DOUBTFUL_SHARE:
                warnings.warn(
                    f"{share:.1e} of the power along {name} is evanescent, which is dropped; at {z:.3g} m, nearer than "
                    f"two pitches of {step:.3g} m, some of it would arrive; the limit is {DOUBTFUL_SHARE:.0e}. "
                    f"Use at least {2 * step:.3g} m.",
                    SamplingWarning,
                    stacklevel=3,
                )
            continue
        # Order 1 of the pixels is as good a reading of the samples as order 0, and falls into the window when its
        # sine, wavelength / pitch less its own, is below that of the window's far corner.
        sine = n * step / sqrt((n * step) ** 2 + z * z)
        edge = max(0.45, 1 - sine * step / wavelength_m)
        share = _share_beyond(field, axis - 2, edge)
        if share > DOUBTFUL_SHARE:
            limit = switch_distance(n, pitch_m=step, wavelength_m=wavelength_m)
            warnings.warn(
                f"{share:.1e} of the power is within {1 - 2 * edge:.1%} of the sampling limit along {name} "
                f"({n} {lines} at {step:.3g} m): between the samples it could be anything, and at {z:.3g} m that "
                f"decides what arrives; the limit is {DOUBTFUL_SHARE:.0e}. Sample finer, soften the edges over two "
                f"pixels, or use more than {limit:.3g} m.",
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
