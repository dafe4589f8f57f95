"""What the panel does to the light: the phase of its levels, how flat it is, and the beam that falls on it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array, Panel
from holocal.optics.zernike import noll_to_nm, zernike
from holocal.records.rig_model import IlluminationTable, SlmTable
from holocal.units import MM, NM, UM
from rigs.simulated.kernel import Box, interpolate
from rigs.simulated.pupil import Complex, unit_phase


def pixels_of(slm: SlmTable) -> Panel:
    """Return the panel's pixels."""
    return Panel(slm.width, slm.height, slm.pitch_um * UM)


def phase_of_levels(slm: SlmTable, wavelength_m: float) -> Array:
    """Return the phase of every level, (2**bits,) radians, at a wavelength.

    A measured table scales as a path difference does; the liquid crystal's dispersion is neglected.
    """
    steps = 2**slm.bits
    if slm.response == "ideal":
        return np.asarray(2 * np.pi * np.arange(steps) / steps)
    scale = 1.0 if slm.response_nm is None else slm.response_nm * NM / wavelength_m
    return np.array(slm.response) * scale


def modulation(slm: SlmTable, levels: NDArray[np.uint8], wavelength_m: float) -> Complex:
    """Return what the levels do to the light, (height, width) complex64 of modulus 1."""
    table = phase_of_levels(slm, wavelength_m)
    if slm.crosstalk_um > 0:  # the fringing field blurs the phase itself, fly-back of a wrap included
        kernel = crosstalk_kernel(slm.crosstalk_um / slm.pitch_um)
        phase = cv2.sepFilter2D(table.astype(np.float32)[levels], -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
        return unit_phase(phase.astype(np.float64))
    return np.asarray(np.take(unit_phase(table), levels))


def crosstalk_kernel(sigma_px: float) -> Array:
    """Return what of its neighbours' phase a pixel has, (odd,): the mean over it of their squares, blurred.

    A square blurred by a Gaussian and averaged over a square is the second difference of the Gaussian's second integral
    x Phi(x) + sigma^2 phi(x). The Gaussian at the pixels alone would leave 0.57 of a grating of two pixels at a blur of
    half a pixel, where 0.24 are left.
    """
    reach = int(np.ceil(5 * sigma_px)) + 1
    x = np.arange(-reach - 1, reach + 2) / sigma_px
    below = np.array([0.5 * math.erfc(-t / math.sqrt(2)) for t in x])
    integral = sigma_px * (x * below + np.exp(-x * x / 2) / math.sqrt(2 * math.pi))
    kernel = np.diff(integral, 2)
    return np.asarray(kernel / kernel.sum())


def flatness_m(slm: SlmTable) -> Array | None:
    """Return the optical path that the panel's shape adds, (height, width) metres, None where it is flat.

    The Zernike polynomials are those of the circle round the panel, in Noll's norm: the rms over that circle.
    """
    if not slm.flatness_nm:
        return None
    panel = pixels_of(slm)
    half_x, half_y = panel.half_size_m
    radius = float(np.hypot(half_x, half_y))
    noll = [index for index, _ in slm.flatness_nm]
    nodes = max(noll_to_nm(index)[0] for index in noll) + 1  # enough for the interpolation to be exact
    box = Box(-half_x, half_x, -half_y, half_y)
    x, y = np.meshgrid(*box.nodes(nodes))
    path = np.tensordot(np.array([rms * NM for _, rms in slm.flatness_nm]), zernike(noll, x / radius, y / radius), 1)
    return interpolate(box, path).on_grid(panel.x_m, panel.y_m)


def beam(light: IlluminationTable, panel: Panel) -> NDArray[np.float32] | None:
    """Return the amplitude of the light on the panel, (height, width), None where it is 1 everywhere."""
    if light.profile == "flat":
        return None
    waist = light.waist_mm * MM  # of intensity, 1/e^2: the amplitude falls to 1/e there
    x, y = np.exp(-((panel.x_m / waist) ** 2)), np.exp(-((panel.y_m / waist) ** 2))
    return np.asarray(np.outer(y, x), np.float32)


def before_modulation(
    slm: SlmTable, light: IlluminationTable, wavelength_m: float
) -> NDArray[np.float32] | Complex | None:
    """Return the light that the levels then modulate, (height, width), less its tilt; None where it is 1 everywhere."""
    amplitude, path = beam(light, pixels_of(slm)), flatness_m(slm)
    if path is None:
        return amplitude
    wave = unit_phase(2 * np.pi / wavelength_m * path)
    return wave if amplitude is None else wave * amplitude
