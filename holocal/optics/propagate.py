"""Free space from one plane to a parallel one: angular spectrum, impulse response, and the direct sum that judges them.

Time factor exp(-i w t): a wave along +z carries exp(+i k z). Fields are (..., rows, columns), row 0 on top, so x
ascends with the column and y descends with the row; free space looks the same from both sides.
Both fast methods pad to twice the size, so nothing wraps round, and return the field on the same pixels. A negative
distance goes back, and is the adjoint.
"""

from __future__ import annotations

from math import pi

import numpy as np
import torch

from holocal.errors import SamplingError, UsageError
from holocal.optics.bench import Array

Pitch = float | tuple[float, float]


def propagate(field: torch.Tensor, *, pitch_m: Pitch, wavelength_m: float, distance_m: float) -> torch.Tensor:
    """Return the field `distance_m` further, by the method whose kernel the padded grid can hold.

    The angular spectrum up to the `critical_distance`, the impulse response beyond.
    """
    limit = critical_distance(field.shape[-2:], pitch_m=pitch_m, wavelength_m=wavelength_m)
    method = angular_spectrum if abs(distance_m) <= limit else impulse_response
    return method(field, pitch_m=pitch_m, wavelength_m=wavelength_m, distance_m=distance_m)


def critical_distance(shape: torch.Size | tuple[int, ...], *, pitch_m: Pitch, wavelength_m: float) -> float:
    """Return z_c = N pitch^2 / wavelength, N being the padded size, the smaller one of the two axes.

    Below it the transfer function is the smoother kernel, beyond it the impulse response.
    """
    steps = _steps(pitch_m, wavelength_m)
    return min(2 * n * step * step / wavelength_m for n, step in zip(shape[-2:], steps, strict=True))


def angular_spectrum(field: torch.Tensor, *, pitch_m: Pitch, wavelength_m: float, distance_m: float) -> torch.Tensor:
    """Return the field `distance_m` further, by its plane waves (band-limited: doi:10.1364/OE.17.019662).

    Each plane wave is multiplied by exp(+i 2 pi z sqrt(1/lambda^2 - fx^2 - fy^2)); evanescent ones are dropped, and
    so are those whose phase changes by more than pi between neighbouring frequencies: their light leaves the padded
    window.

    Parameters
    ----------
    field
        (..., rows, columns) complex64 or complex128; the result has its type and device.
    pitch_m
        Pixel pitch, one number or (along rows' y, along columns' x).
    wavelength_m, distance_m
        Metres; the distance may be negative.
    """
    steps = _steps(pitch_m, wavelength_m)
    rows, columns = (2 * n for n in field.shape[-2:])
    fy, fx = np.fft.fftfreq(rows, steps[0])[:, None], np.fft.fftfreq(columns, steps[1])[None, :]
    square = wavelength_m**-2 - fx * fx - fy * fy
    turns = distance_m * np.sqrt(np.maximum(square, 0.0))
    kept = square > 0
    for f, n, step in ((fy, rows, steps[0]), (fx, columns, steps[1])):
        # local frequency z |f| / sqrt(square) of the transfer function against half the padded window, n step / 2
        kept = kept & (np.abs(f * distance_m) <= np.sqrt(np.maximum(square, 0.0)) * (n * step / 2))
    return _convolve(field, _phasor(turns, field) * _real(kept, field))


def impulse_response(field: torch.Tensor, *, pitch_m: Pitch, wavelength_m: float, distance_m: float) -> torch.Tensor:
    """Return the field `distance_m` further, by padded convolution with the Rayleigh-Sommerfeld kernel.

    The same sum as `rayleigh_sommerfeld_sum`, in N log N: for distances where the kernel is sampled well (beyond
    `critical_distance`). Parameters as in `angular_spectrum`; the distance is not 0.
    """
    steps = _steps(pitch_m, wavelength_m)
    rows, columns = (2 * n for n in field.shape[-2:])
    y = np.asarray(np.fft.fftfreq(rows, 1 / (rows * steps[0])))[:, None]  # 0, 1, .. -1 steps
    x = np.asarray(np.fft.fftfreq(columns, 1 / (columns * steps[1])))[None, :]
    amplitude, turns = _kernel(x, y, wavelength_m=wavelength_m, distance_m=distance_m)
    kernel = _phasor(turns, field) * _real(amplitude * (steps[0] * steps[1]), field)
    return _convolve(field, torch.fft.fft2(kernel))


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
    steps = _steps(pitch_m, wavelength_m)
    rows, columns = field.shape[-2:]
    y = ((rows - 1) / 2 - np.arange(rows)) * steps[0]
    x = (np.arange(columns) - (columns - 1) / 2) * steps[1]
    source = field.to(torch.complex128).cpu().numpy()
    out = np.empty(len(points_m), np.complex128)
    for i, (px, py) in enumerate(points_m):
        away_x, away_y = (px - x)[None, :], (py - y)[:, None]
        amplitude, turns = _kernel(away_x, away_y, wavelength_m=wavelength_m, distance_m=distance_m)
        out[i] = np.sum(source * amplitude * np.exp(2j * pi * (turns - np.round(turns))))
    return torch.from_numpy(out * (steps[0] * steps[1]))


def _kernel(x: Array, y: Array, *, wavelength_m: float, distance_m: float) -> tuple[Array, Array]:
    """Return modulus and phase (turns) of the first Rayleigh-Sommerfeld kernel z / (2 pi r^2) (1/r - ik) exp(ikr).

    For a negative distance its conjugate, which goes back.
    """
    if distance_m == 0:
        raise UsageError("The Rayleigh-Sommerfeld kernel has no distance 0.", fix="Use angular_spectrum.")
    r = np.sqrt(x * x + y * y + distance_m * distance_m)
    k = 2 * pi / wavelength_m
    amplitude = abs(distance_m) / (2 * pi * r * r) * np.hypot(1 / r, k)
    turns = r / wavelength_m - np.arctan2(k, 1 / r) / (2 * pi)
    return amplitude, np.sign(distance_m) * turns


def _convolve(field: torch.Tensor, transfer: torch.Tensor) -> torch.Tensor:
    """Return the field, padded to the transfer function's size, filtered by it, and cut back."""
    rows, columns = field.shape[-2:]
    size = (int(transfer.shape[-2]), int(transfer.shape[-1]))
    out: torch.Tensor = torch.fft.ifft2(torch.fft.fft2(field, s=size) * transfer)[..., :rows, :columns]
    return out


def _phasor(turns: Array, like: torch.Tensor) -> torch.Tensor:
    """Return exp(2 pi i turns) in the type of `like`: reduced in float64, cast once."""
    reduced = _real(2 * pi * (turns - np.round(turns)), like)
    return torch.polar(torch.ones_like(reduced), reduced)


def _real(values: Array | np.ndarray[tuple[int, ...], np.dtype[np.bool_]], like: torch.Tensor) -> torch.Tensor:
    real = torch.float64 if like.dtype == torch.complex128 else torch.float32
    return torch.from_numpy(np.ascontiguousarray(values)).to(device=like.device, dtype=real)


def _steps(pitch_m: Pitch, wavelength_m: float) -> tuple[float, float]:
    """Return the pitch (y, x), checked."""
    steps = pitch_m if isinstance(pitch_m, tuple) else (pitch_m, pitch_m)
    if not (min(steps) > 0 and wavelength_m > 0):
        raise SamplingError(f"Pitch {steps} m and wavelength {wavelength_m} m must be above 0.")
    return steps
