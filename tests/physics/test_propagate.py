"""Propagation against closed forms (tilted plane wave, astigmatic tilted Gaussian beam) and the direct sum."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from planes import WAVELENGTH, axes, relative

from holocal.errors import UsageError
from holocal.optics.propagate import (
    angular_spectrum,
    critical_distance,
    impulse_response,
    propagate,
    rayleigh_sommerfeld_sum,
)

K = 2 * np.pi / WAVELENGTH


def gaussian_beam(x, y, z, *, waist=(60e-6, 90e-6), focus=(-2e-3, 3e-3), centre=(70e-6, -40e-6), tilt=(0.012, -0.02)):
    """Astigmatic, off-axis, tilted: a paraxial beam with its own waist place on each axis, and a linear phase.

    A paraxial tilt is a shift of the spectrum: the beam moves by tilt z and gains -k tilt^2 z / 2.
    """
    field = np.exp(1j * K * z)
    for u, w0, zf, c, t in zip((x, y), waist, focus, centre, tilt, strict=True):
        range_m = np.pi * w0**2 / WAVELENGTH
        moved = u - c - t * z
        q, q0 = (z - zf) - 1j * range_m, -zf - 1j * range_m
        field = field * np.sqrt(q0 / q) * np.exp(1j * K * moved**2 / (2 * q))
        field = field * np.exp(1j * K * (t * (u - c) - t**2 * z / 2))
    return field


def test_a_tilted_plane_wave_gains_the_phase_of_its_kz_under_a_soft_aperture():
    # The centre of a wide soft aperture sees the plane wave itself: at 1 mm, Fresnel effects of a 0.3 mm Gaussian are
    # (z / z_R)^2 / 2 = 2e-6. Rows and columns differ, and so do the pitches.
    pitch, z = (3e-6, 4e-6), 1e-3
    x, y = axes(384, 256, pitch)
    sx, sy = 0.021, -0.034
    wave = np.exp(1j * K * (sx * x + sy * y)) * np.exp(-((x**2 + y**2) / 0.3e-3**2))
    out = angular_spectrum(torch.from_numpy(wave), pitch_m=pitch, wavelength_m=WAVELENGTH, distance_m=z).numpy()
    kz = K * np.sqrt(1 - sx**2 - sy**2)
    i = np.argmin(np.hypot(x - sx * z, y - sy * z))
    wanted = np.exp(1j * (K * (sx * x.flat[i] + sy * y.flat[i]) + kz * z))
    assert abs(np.angle(out.flat[i] / wanted)) < 0.01  # z / z_R = 1.8e-3 rad of Gouy phase
    assert abs(abs(out.flat[i]) - 1) < 0.005  # the pixel nearest to the moved centre is 2 um off


@pytest.mark.parametrize(("shape", "pitch"), [((256, 256), (2e-6, 2e-6)), ((240, 320), (2.5e-6, 2e-6))])
@pytest.mark.parametrize("z", [1e-3, -0.7e-3])
def test_an_astigmatic_off_axis_tilted_gaussian_beam_comes_out_as_its_closed_form(shape, pitch, z):
    x, y = axes(*shape, pitch)
    start = torch.from_numpy(gaussian_beam(x, y, 0.0))
    out = angular_spectrum(start, pitch_m=pitch, wavelength_m=WAVELENGTH, distance_m=z).numpy()
    # Paraxial phases of fourth order: k z sin^4 / 8 with sin = 0.026 is 7e-4 rad, common to the beam.
    assert relative(out, gaussian_beam(x, y, z)) < 2e-3


def test_complex64_agrees_with_complex128_to_single_precision():
    x, y = axes(256, 200, (3e-6, 3e-6))
    start = torch.from_numpy(gaussian_beam(x, y, 0.0))
    keys = {"pitch_m": 3e-6, "wavelength_m": WAVELENGTH, "distance_m": 2e-3}
    fine, coarse = angular_spectrum(start, **keys), angular_spectrum(start.to(torch.complex64), **keys)
    assert coarse.dtype == torch.complex64
    # k z is 24000 rad: in float32 it would be off by 1e-3 rad; reduced in float64 only FFT rounding is left
    assert relative(coarse.numpy(), fine.numpy()) < 2e-6


@pytest.mark.parametrize(("method", "z"), [(angular_spectrum, 5e-3), (impulse_response, 20e-3)])
def test_there_and_back_is_where_it_started(method, z):
    x, y = axes(256, 256, (3.74e-6, 3.74e-6))
    start = torch.from_numpy(gaussian_beam(x, y, 0.0, tilt=(0.004, -0.003)))
    keys = {"pitch_m": 3.74e-6, "wavelength_m": WAVELENGTH}
    back = method(method(start, distance_m=z, **keys), distance_m=-z, **keys)
    # Light that leaves the 0.96 mm window at z is lost: the beam's waist of 60 um grows to 75 um at 20 mm and moves by
    # 80 um, so its far tail, exp(-(250 / 75)^2) = 1e-5 in amplitude, is cut there.
    assert relative(back.numpy(), start.numpy()) < 1e-4


@pytest.mark.parametrize("method", [angular_spectrum, impulse_response])
@pytest.mark.parametrize("z", [4e-3, 40e-3])
def test_a_negative_distance_is_the_adjoint(method, z):
    rng = np.random.default_rng(1)
    a, b = (torch.from_numpy(rng.normal(size=(2, 48, 64)) + 1j * rng.normal(size=(2, 48, 64))) for _ in "ab")
    keys = {"pitch_m": (3e-6, 4e-6), "wavelength_m": WAVELENGTH}
    there, back = method(a, distance_m=z, **keys), method(b, distance_m=-z, **keys)
    left, right = torch.vdot(b.flatten(), there.flatten()), torch.vdot(back.flatten(), a.flatten())
    assert abs(complex(left - right)) < 1e-10 * float(torch.linalg.vector_norm(a)) * float(torch.linalg.vector_norm(b))


@pytest.mark.parametrize("z", [5e-3, 50e-3, 200e-3])
def test_propagation_agrees_with_the_direct_sum(z):
    # A soft aperture, tilted, off centre. At 5 mm the direct sum's own kernel is sampled well only within 0.35 mm of
    # sideways travel (wavelength z / (2 pitch)), so points are taken near the beam there.
    pitch, n = 3.74e-6, 256
    x, y = axes(n, n, (pitch, pitch))
    width = 45e-6 if z < 10e-3 else 150e-6
    soft = np.exp(-(((x - 30e-6) / width) ** 2) - ((y + 20e-6) / width / 1.2) ** 2)
    start = torch.from_numpy(soft * np.exp(1j * K * (0.004 * x - 0.006 * y)))
    out = propagate(start, pitch_m=pitch, wavelength_m=WAVELENGTH, distance_m=z).numpy()
    reach = 120e-6 if z < 10e-3 else 400e-6
    rng = np.random.default_rng(2)
    rows, columns = np.nonzero((abs(x) < reach) & (abs(y) < reach))
    pick = rng.choice(len(rows), 60, replace=False)
    rows, columns = rows[pick], columns[pick]
    points = np.stack([x[rows, columns], y[rows, columns]], axis=-1)
    exact = rayleigh_sommerfeld_sum(start, points, pitch_m=pitch, wavelength_m=WAVELENGTH, distance_m=z).numpy()
    assert relative(out[rows, columns], exact) < 1e-5


@pytest.mark.filterwarnings("ignore::holocal.errors.SamplingWarning")  # a point has light at every frequency
def test_the_method_changes_at_the_critical_distance():
    start = torch.zeros((64, 64), dtype=torch.complex128)
    start[30, 35] = 1
    keys = {"pitch_m": 3e-6, "wavelength_m": WAVELENGTH}
    limit = critical_distance(start.shape, **keys)
    assert limit == pytest.approx(128 * 9e-12 / WAVELENGTH)
    for z, method in ((0.99 * limit, angular_spectrum), (1.01 * limit, impulse_response)):
        assert torch.equal(propagate(start, distance_m=z, **keys), method(start, distance_m=z, **keys))


def test_evanescent_waves_are_dropped_and_nothing_is_nan():
    start = torch.ones((32, 32), dtype=torch.complex128)
    out = angular_spectrum(start, pitch_m=0.2e-6, wavelength_m=WAVELENGTH, distance_m=1e-6)
    assert bool(torch.isfinite(out.real).all() and torch.isfinite(out.imag).all())
    alternating = start * torch.tensor([1.0, -1.0]).repeat(16)  # 2.5 cycles per um: beyond 1 / wavelength
    gone = angular_spectrum(alternating, pitch_m=0.2e-6, wavelength_m=WAVELENGTH, distance_m=1e-6)
    assert float(gone[8:24, 8:24].abs().max()) < 0.3  # what is left is diffraction at the aperture's edges


def test_zero_distance_changes_nothing_and_has_no_kernel():
    rng = np.random.default_rng(3)
    start = torch.from_numpy(rng.normal(size=(20, 30)) + 0j)
    keys = {"pitch_m": 3e-6, "wavelength_m": WAVELENGTH, "distance_m": 0.0}
    assert torch.allclose(angular_spectrum(start, **keys), start, atol=1e-13)
    with pytest.raises(UsageError):
        impulse_response(start, **keys)
