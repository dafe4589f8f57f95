"""Free space from one plane to a parallel one: the right kernel for each distance, and the direct sum that judges it.

Time factor exp(-i w t): a wave along +z carries exp(+i k z). Fields are (..., rows, columns), row 0 on top, so x
ascends with the column and y descends with the row; free space looks the same from both sides.
All fast methods pad to twice the size, so nothing wraps round, and return the field on the same pixels. A negative
distance goes back, and is the adjoint.

The field is one that its samples determine: nothing beyond the sampling limit 1 / (2 pitch). Beyond the switch
distance, the pixels as points (`rayleigh_sommerfeld_sum`) give the same on all of the window, hard edges or not.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, pi

import numpy as np
import torch

from holocal.errors import SamplingError, UsageError
from holocal.optics.bench import Array
from holocal.optics.doubtful_light import warn_of_doubtful_light
from holocal.optics.free_space_kernel import (
    padded_size,
    rayleigh_sommerfeld_kernel,
    sampled_in_space,
    transfer_quadrant,
)
from holocal.optics.padded_convolution import convolve

Pitch = float | tuple[float, float]


def propagate(field: torch.Tensor, *, pitch_m: Pitch, wavelength_m: float, distance_m: float) -> torch.Tensor:
    """Return the field `distance_m` further, each axis by the kernel that the padded grid can hold.

    The angular spectrum up to the `critical_distance`, the impulse response beyond, and between the two axes' own
    critical distances the mixed kernel: impulse response along the short axis, angular spectrum along the long one.

    Parameters
    ----------
    field
        (..., rows, columns) complex64 or complex128; the result has its type and device.
    pitch_m
        Pixel pitch, one number or (along rows' y, along columns' x).
    wavelength_m, distance_m
        Metres; the distance may be negative, which is the adjoint, or 0, which changes nothing.

    Warns
    -----
    SamplingWarning
        Where no method can be right: nearer than the switch, and the field has light at the sampling limit, so that
        what is between its samples decides; or nearer than three fine pitches, and it has evanescent light.

    See Also
    --------
    Propagator : The same, prepared once for many fields; it does not look for doubtful light.
    """
    _check(field)
    steps = _steps(pitch_m, wavelength_m)
    _check_distance(distance_m)
    if distance_m == 0:
        return field.clone()
    warn_of_doubtful_light(field, steps, wavelength_m=wavelength_m, distance_m=distance_m)
    propagator = Propagator.prepare(
        field.shape, pitch_m=pitch_m, wavelength_m=wavelength_m, distance_m=distance_m, like=field
    )
    return propagator.forward(field)


@dataclass(frozen=True)
class Propagator:
    """Free space of one length for fields of one size: what `propagate` does, prepared.

    Attributes
    ----------
    shape
        (rows, columns) of its fields.
    quadrant
        What the padded field's frequencies 0 .. n/2 are multiplied by; 66 MB for 2160 x 3840 in complex64.
    """

    shape: tuple[int, int]
    quadrant: torch.Tensor

    @classmethod
    def prepare(
        cls,
        shape: torch.Size | tuple[int, ...],
        *,
        pitch_m: Pitch,
        wavelength_m: float,
        distance_m: float,
        like: torch.Tensor | None = None,
    ) -> Propagator:
        """Return the propagator for the last two sizes of `shape`, of the type and device of `like` (complex64, CPU).

        Errors as in `propagate`.
        """
        steps = _steps(pitch_m, wavelength_m)
        _check_distance(distance_m)
        in_space = sampled_in_space(shape, steps, wavelength_m=wavelength_m, distance_m=distance_m)
        return _prepared(shape, steps, in_space, wavelength_m=wavelength_m, distance_m=distance_m, like=like)

    def forward(self, field: torch.Tensor) -> torch.Tensor:
        """Return the (..., rows, columns) field at the distance."""
        return convolve(self._fitting(field), self.quadrant)

    def adjoint(self, field: torch.Tensor) -> torch.Tensor:
        """Return the field that the adjoint of `forward` makes: the way back, for light that stayed in the window."""
        return convolve(self._fitting(field), self.quadrant, adjoint=True)

    def _fitting(self, field: torch.Tensor) -> torch.Tensor:
        _check(field)
        if tuple(field.shape[-2:]) != self.shape or field.dtype != self.quadrant.dtype:
            raise UsageError(
                f"A field of {tuple(field.shape)} {field.dtype}; the propagator is for {self.shape} "
                f"{self.quadrant.dtype}.",
                fix="Prepare a propagator like this field.",
            )
        return field


def critical_distance(shape: torch.Size | tuple[int, ...], *, pitch_m: Pitch, wavelength_m: float) -> float:
    """Return z_c = N pitch^2 / wavelength, N being the padded size, the smaller one of the two axes.

    Below it the transfer function is the smoother kernel, beyond it the impulse response. `propagate` switches each
    axis at its own, less the cosine that this leaves out (0.2 % at 3.74 um and 515 nm).
    """
    steps = _steps(pitch_m, wavelength_m)
    return min(2 * n * step * step / wavelength_m for n, step in zip(shape[-2:], steps, strict=True))


def angular_spectrum(field: torch.Tensor, *, pitch_m: Pitch, wavelength_m: float, distance_m: float) -> torch.Tensor:
    """Return the field `distance_m` further, by its plane waves (band-limited: doi:10.1364/OE.17.019662).

    Each plane wave is multiplied by exp(+i 2 pi z sqrt(1/lambda^2 - fx^2 - fy^2)); evanescent ones are dropped, and
    so are those whose phase changes by more than pi between neighbouring frequencies: their light leaves the padded
    window. Parameters as in `propagate`.
    """
    return _by_one_method(field, pitch_m, False, wavelength_m=wavelength_m, distance_m=distance_m)


def impulse_response(field: torch.Tensor, *, pitch_m: Pitch, wavelength_m: float, distance_m: float) -> torch.Tensor:
    """Return the field `distance_m` further, by padded convolution with the Rayleigh-Sommerfeld kernel.

    The same sum as `rayleigh_sommerfeld_sum`, in N log N: for distances where the kernel is sampled well (beyond
    `critical_distance`). Parameters as in `propagate`; the distance is not 0.
    """
    if distance_m == 0:
        raise UsageError("The Rayleigh-Sommerfeld kernel has no distance 0.", fix="Use angular_spectrum.")
    return _by_one_method(field, pitch_m, True, wavelength_m=wavelength_m, distance_m=distance_m)


def rayleigh_sommerfeld_sum(
    field: torch.Tensor, points_m: Array, *, pitch_m: Pitch, wavelength_m: float, distance_m: float
) -> torch.Tensor:
    """Return the field at points of the plane `distance_m` further by direct summation: slow, the judge of the others.

    Parameters
    ----------
    field
        (rows, columns), summed in complex128.
    points_m
        (n, 2) of x (to the right) and y (up), metres from the centre of the aperture.
    """
    if distance_m == 0:
        raise UsageError("The Rayleigh-Sommerfeld kernel has no distance 0.", fix="The field is its own.")
    steps = _steps(pitch_m, wavelength_m)
    rows, columns = field.shape[-2:]
    y = ((rows - 1) / 2 - np.arange(rows)) * steps[0]
    x = (np.arange(columns) - (columns - 1) / 2) * steps[1]
    source = field.to(torch.complex128).cpu().numpy()
    out = np.empty(len(points_m), np.complex128)
    for i, (px, py) in enumerate(points_m):
        away_x, away_y = (px - x)[None, :], (py - y)[:, None]
        amplitude, turns = rayleigh_sommerfeld_kernel(away_x, away_y, wavelength_m=wavelength_m, distance_m=distance_m)
        out[i] = np.sum(source * amplitude * np.exp(2j * pi * (turns - np.round(turns))))
    return torch.from_numpy(out * (steps[0] * steps[1]))


def _by_one_method(
    field: torch.Tensor, pitch_m: Pitch, in_space: bool, *, wavelength_m: float, distance_m: float
) -> torch.Tensor:
    """Return the field by the impulse response (`in_space`) or by the angular spectrum along both axes."""
    _check(field)
    steps = _steps(pitch_m, wavelength_m)
    _check_distance(distance_m)
    keys = {"wavelength_m": wavelength_m, "distance_m": distance_m}
    return _prepared(field.shape, steps, (in_space, in_space), **keys, like=field).forward(field)


def _prepared(
    shape: torch.Size | tuple[int, ...],
    steps: tuple[float, float],
    in_space: tuple[bool, bool],
    *,
    wavelength_m: float,
    distance_m: float,
    like: torch.Tensor | None,
) -> Propagator:
    """Return the propagator whose kernel is sampled in space along the given axes (y, x): float64, cast once."""
    rows, columns = shape[-2:]
    if min(rows, columns) < 1:
        raise UsageError(f"A field of {rows} x {columns} pixels has no light.")
    quadrant = transfer_quadrant(
        (padded_size(rows), padded_size(columns)),
        steps_m=steps,
        wavelength_m=wavelength_m,
        distance_m=distance_m,
        in_space=in_space,
    )
    dtype, device = (torch.complex64, None) if like is None else (like.dtype, like.device)
    return Propagator((rows, columns), torch.from_numpy(np.ascontiguousarray(quadrant)).to(device=device, dtype=dtype))


def _steps(pitch_m: Pitch, wavelength_m: float) -> tuple[float, float]:
    """Return the pitch (y, x), checked."""
    steps = pitch_m if isinstance(pitch_m, tuple) else (pitch_m, pitch_m)
    if not all(isfinite(size) and size > 0 for size in (*steps, wavelength_m)):
        raise SamplingError(f"Pitch {steps} m and wavelength {wavelength_m} m must be finite and above 0.")
    return steps


def _check(field: torch.Tensor) -> None:
    """Refuse what is no field."""
    if field.ndim < 2 or field.dtype not in (torch.complex64, torch.complex128):
        raise UsageError(
            f"A field is (..., rows, columns), complex64 or complex128, not {tuple(field.shape)} {field.dtype}."
        )


def _check_distance(distance_m: float) -> None:
    """Refuse a distance that no kernel has."""
    if not isfinite(distance_m):
        raise UsageError(
            f"A distance of {distance_m} m has no plane with the same pixels.",
            fix="The far field is the Fourier transform: torch.fft.fft2(field, norm='ortho').",
        )
