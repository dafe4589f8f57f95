"""The kernel of free space on a padded grid, each axis sampled where it is smooth: in space or in frequency.

All are one function, seen from either side of a Fourier transform: the Rayleigh-Sommerfeld impulse response
h(y, x), the transfer function H(fy, fx), and between them, for panels that are longer than high, the two mixed ones
h(y; fx) and h(fy; x), which are cylinder waves in closed form. It is even along both axes, so a quarter is kept.
"""

from __future__ import annotations

from math import fmod, pi, sqrt

import numpy as np
import scipy.fft
import scipy.special
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array

Complex = NDArray[np.complex128]


def padded_size(n: int) -> int:
    """Return the even size, at least 2 n, that n samples are padded to: fast, and with room for the kernel.

    At least 64: the transfer function of a few pixels, sampled at twice as many frequencies, is no integral yet.
    """
    return 2 * int(scipy.fft.next_fast_len(max(n, 32)))


def switch_distance(n: int, *, pitch_m: float, wavelength_m: float) -> float:
    """Return the distance from which one axis of n pixels is better sampled in space than in frequency.

    There a wave at the sampling limit 1 / (2 pitch) moves sideways by n pixels: n pitch sqrt((2 pitch / lambda)^2 - 1),
    which is `critical_distance` less the cosine of that wave. Below half a wavelength of pitch the impulse response is
    sampled well everywhere but at its own peak: what that folds over is evanescent, and from 3 pitches on it is below
    exp(-2 pi 3 sqrt(3/4)) = 8e-8.
    """
    slope = sqrt(max((2 * pitch_m / wavelength_m) ** 2 - 1, 0.0))
    return max(n * pitch_m * slope, 3 * pitch_m)


def sampled_in_space(
    shape: tuple[int, ...], steps_m: tuple[float, float], *, wavelength_m: float, distance_m: float
) -> tuple[bool, bool]:
    """Return for (y, x) whether the distance is beyond the axis's own switch."""
    y, x = (
        abs(distance_m) > switch_distance(n, pitch_m=step, wavelength_m=wavelength_m)
        for n, step in zip(shape[-2:], steps_m, strict=True)
    )
    return y, x


def transfer_quadrant(
    padded: tuple[int, int],
    *,
    steps_m: tuple[float, float],
    wavelength_m: float,
    distance_m: float,
    in_space: tuple[bool, bool],
) -> Complex:
    """Return what each frequency of the padded grid is multiplied by: the quarter 0 .. n/2 of both axes.

    Parameters
    ----------
    padded
        Even size (rows, columns); the result is (rows/2 + 1, columns/2 + 1), complex128.
    steps_m
        Pitch along (y, x).
    in_space
        For (y, x): whether the kernel is sampled in space along that axis and then transformed.
    """
    z = abs(distance_m)
    if in_space[0] and not in_space[1]:
        keys = {"wavelength_m": wavelength_m, "distance_m": distance_m}
        return transfer_quadrant(padded[::-1], steps_m=steps_m[::-1], in_space=(False, True), **keys).T
    y, x = (np.arange(n // 2 + 1, dtype=np.float64) * step for n, step in zip(padded, steps_m, strict=True))
    fy, fx = (np.arange(n // 2 + 1, dtype=np.float64) / (n * step) for n, step in zip(padded, steps_m, strict=True))
    if in_space == (True, True):
        amplitude, turns = rayleigh_sommerfeld_kernel(x[None], y[:, None], wavelength_m=wavelength_m, distance_m=z)
        kernel = _phasor(turns) * (amplitude * (steps_m[0] * steps_m[1]))
    elif in_space == (False, True):
        kernel = _cylinder_waves(x[None], fy[:, None], wavelength_m=wavelength_m, distance_m=z) * steps_m[1]
    else:
        windows = (y[-1], x[-1])
        kernel = _plane_waves(fx[None], fy[:, None], windows, wavelength_m=wavelength_m, distance_m=z)
    for axis in (0, 1):
        if in_space[axis]:  # a cosine transform of the first kind is the Fourier transform of the even whole
            kernel = scipy.fft.dct(kernel, type=1, axis=axis, overwrite_x=True, workers=torch.get_num_threads())
    return np.conj(kernel) if distance_m < 0 else kernel


def rayleigh_sommerfeld_kernel(x: Array, y: Array, *, wavelength_m: float, distance_m: float) -> tuple[Array, Array]:
    """Return modulus and phase (turns) of the first Rayleigh-Sommerfeld kernel z / (2 pi r^2) (1/r - ik) exp(ikr).

    For a negative distance its conjugate, which goes back. The whole turns of k z are left out, and r - z has its own
    formula: at 10 km, r / lambda in float64 would be wrong by 2e-5 rad.
    """
    z = abs(distance_m)
    square = x * x + y * y
    r = np.sqrt(square + z * z)
    k = 2 * pi / wavelength_m
    amplitude = z / (2 * pi * r * r) * np.hypot(1 / r, k)
    turns = fmod(z, wavelength_m) / wavelength_m + square / (r + z) / wavelength_m - np.arctan2(k, 1 / r) / (2 * pi)
    return amplitude, np.sign(distance_m) * turns


def _plane_waves(
    fx: Array, fy: Array, windows_m: tuple[float, float], *, wavelength_m: float, distance_m: float
) -> Complex:
    """Return exp(2 pi i z sqrt(1/lambda^2 - f^2)), band-limited (doi:10.1364/OE.17.019662).

    Evanescent waves are dropped, and so are those that move sideways, by z tan, further than half the padded window
    (`windows_m`, (y, x)): their phase changes by more than pi between neighbouring frequencies.
    """
    square = (wavelength_m * fx) ** 2 + (wavelength_m * fy) ** 2
    cosine = np.sqrt(np.maximum(1 - square, 0.0))
    kept = cosine > 0
    for f, window_m in zip((fy, fx), windows_m, strict=True):
        kept &= wavelength_m * distance_m * f <= cosine * window_m
    turns = fmod(distance_m, wavelength_m) / wavelength_m - distance_m / wavelength_m * square / (1 + cosine)
    return _phasor(turns) * kept


def _cylinder_waves(x: Array, fy: Array, *, wavelength_m: float, distance_m: float) -> Complex:
    """Return the Rayleigh-Sommerfeld kernel, transformed along y only: i q z / (2 rho) H1(q rho).

    It is what a line along y sends to the distance rho = hypot(x, z) when its phase runs with fy, and q is the
    wave number that is left, 2 pi sqrt(1/lambda^2 - fy^2). Only for propagating fy.
    """
    rho = np.hypot(x, distance_m)
    per_m = np.sqrt(wavelength_m**-2 - fy * fy)
    turns = rho * per_m
    argument = 2 * pi * turns
    if float(argument.min()) > 200:  # the next term is 0.1 / 200^3 = 1e-8
        series = 1 + 0.375j / argument + 0.1171875 / argument**2
        hankel = np.sqrt(2 / (pi * argument)) * series * np.exp(-0.75j * pi)
    else:
        hankel = scipy.special.hankel1e(1, argument)
    wave: Complex = (1j * pi * distance_m) * per_m / rho * hankel * _phasor(turns)
    return wave


def _phasor(turns: Array) -> Complex:
    """Return exp(2 pi i turns), reduced in float64."""
    angle = 2 * pi * (turns - np.round(turns))
    out = np.empty(angle.shape, np.complex128)
    np.cos(angle, out=out.real)
    np.sin(angle, out=out.imag)
    return out
