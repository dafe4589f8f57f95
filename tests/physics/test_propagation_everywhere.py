"""Propagation at every distance and size: against the direct sum, exact arithmetic, and a plain padded convolution."""

from __future__ import annotations

import warnings
from decimal import Decimal, getcontext

import numpy as np
import pytest
import torch
from planes import WAVELENGTH, axes, relative
from scipy.special import erfc

from holocal.errors import SamplingError, SamplingWarning, UsageError
from holocal.optics.free_space_kernel import switch_distance
from holocal.optics.padded_convolution import convolve, convolve_plainly
from holocal.optics.propagate import (
    Propagator,
    angular_spectrum,
    critical_distance,
    impulse_response,
    propagate,
    rayleigh_sommerfeld_sum,
)

PITCH = 3.74e-6


def beams(shape, *, finer=1):
    """Three Gaussian beams, off centre, with tilts of up to 0.35 cycles per pixel: nothing at the sampling limit.

    Their spectrum falls to exp(-(pi 9 0.15)^2) = 2e-8 there, and they to as little at 38 px from their centres.
    Sampled at the centres of a grid that many times finer.
    """
    rows, columns = (n * finer for n in shape)
    x, y = axes(rows, columns, (1 / finer, 1 / finer))
    field = np.zeros((rows, columns), complex)
    for cx, cy, fx, fy, strength in ((5, -3, 0.02, 0.01, 1), (-8, 6, -0.3, 0.12, 0.7j), (2, 9, 0.16, -0.35, -0.5)):
        field += strength * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 9**2 + 2j * np.pi * (fx * x + fy * y))
    return torch.from_numpy(field)


def soft_disc(n, radius, *, sigma=2.0, finer=1):
    """A disc whose edge is blurred by a Gaussian, lengths in pixels of the coarse grid."""
    radii = np.hypot(*axes(n * finer, n * finer, (1 / finer, 1 / finer)))
    return torch.from_numpy(0.5 * erfc((radii - radius) / (np.sqrt(2) * sigma)) + 0j)


def pixels(shape, pitch, count, seed=0):
    """Random pixels and where they are: rows, columns, (count, 2) points."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(0, shape[0], count), rng.integers(0, shape[1], count)
    x, y = (columns - (shape[1] - 1) / 2) * pitch[1], ((shape[0] - 1) / 2 - rows) * pitch[0]
    return rows, columns, np.stack([x, y], axis=-1)


def finer_than_the_orders(shape, pitch, z):
    """How much finer the sum's grid must be for its own diffraction orders to miss the window."""
    reach = max(np.sin(np.arctan(n * step / z)) * step for n, step in zip(shape, pitch, strict=True))
    return int(np.ceil(reach / WAVELENGTH + 0.5))


def noise(shape, dtype=torch.complex128, seed=0):
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("shape", "pitch"),
    [((100, 100), (PITCH, PITCH)), ((100, 160), (PITCH, PITCH)), ((120, 96), (3e-6, 5e-6))],
)
def test_single_precision_agrees_with_the_direct_sum_at_every_distance(shape, pitch):
    switches = [switch_distance(n, pitch_m=step, wavelength_m=WAVELENGTH) for n, step in zip(shape, pitch, strict=True)]
    near = [limit * part for limit in switches for part in (0.99, 1.01)]
    rows, columns, points = pixels(shape, pitch, 20)
    for z in sorted({0.6e-3, 2.5e-3, float(np.mean(switches)), 30e-3, 1.0, *near}):
        keys = {"wavelength_m": WAVELENGTH, "distance_m": z}
        found = propagate(beams(shape).to(torch.complex64), pitch_m=pitch, **keys).numpy()[rows, columns]
        m = finer_than_the_orders(shape, pitch, z)
        fine = (pitch[0] / m, pitch[1] / m)
        exact = rayleigh_sommerfeld_sum(beams(shape, finer=m), points, pitch_m=fine, **keys).numpy()
        # 20 pixels, most of them in the light, against the rounding of all: measured at most 4e-7
        assert relative(found, exact) < 2e-6, z


@pytest.mark.parametrize("part", [0.36, 0.99, 1.01, 3.6, 14.4])
def test_a_soft_disc_agrees_with_the_direct_sum_on_both_sides_of_the_switch(part):
    n = 256
    z = part * critical_distance((n, n), pitch_m=PITCH, wavelength_m=WAVELENGTH)  # 5 to 200 mm
    keys = {"wavelength_m": WAVELENGTH, "distance_m": z}
    m = 2 if part < 1 else 1
    rows, columns, points = pixels((n, n), (PITCH, PITCH), 40)
    found = propagate(soft_disc(n, 67).to(torch.complex64), pitch_m=PITCH, **keys).numpy()
    exact = rayleigh_sommerfeld_sum(soft_disc(n, 67, finer=m), points, pitch_m=PITCH / m, **keys).numpy()
    # 40 of the pixels, of which some are dark, against the rounding of all: measured 1.4e-7 over the whole window
    assert relative(found[rows, columns], exact) < 1e-6


def test_random_pixels_beyond_the_switch_are_summed_to_rounding():
    shape, z = (60, 90), 9e-3
    field = noise(shape)
    rows, columns, points = pixels(shape, (PITCH, PITCH), 30)
    keys = {"pitch_m": PITCH, "wavelength_m": WAVELENGTH, "distance_m": z}
    exact = rayleigh_sommerfeld_sum(field, points, **keys).numpy()
    assert relative(propagate(field, **keys).numpy()[rows, columns], exact) < 1e-12
    single = propagate(field.to(torch.complex64), **keys).numpy()[rows, columns]
    assert relative(single, exact) < 1e-6  # rounding, measured 2e-7


@pytest.mark.parametrize("shape", [(1, 1), (1, 37), (37, 1), (31, 53), (2, 97)])
def test_odd_prime_and_single_pixel_sizes_are_summed_right(shape):
    field, pitch, z = noise(shape), (PITCH, 4.5e-6), 20e-3
    rows, columns, points = pixels(shape, pitch, 20)
    keys = {"pitch_m": pitch, "wavelength_m": WAVELENGTH, "distance_m": z}
    exact = rayleigh_sommerfeld_sum(field, points, **keys).numpy()
    assert relative(propagate(field, **keys).numpy()[rows, columns], exact) < 1e-12


def test_one_pixel_nearer_than_its_switch_is_the_integral_over_its_band():
    # Light at the sampling limit is doubtful, and said to be; what is returned is a sinc's.
    keys = {"pitch_m": PITCH, "wavelength_m": WAVELENGTH, "distance_m": 20e-6}
    with pytest.warns(SamplingWarning, match=r"1\.1e-01 of the power along [xy] \(1 pixels of 3\.74e-06 m\)"):
        found = complex(propagate(torch.ones((1, 1), dtype=torch.complex128), **keys)[0, 0])
    f = (np.arange(2000) + 0.5) / 2000 / (2 * PITCH)
    square = WAVELENGTH**-2 - f[:, None] ** 2 - f[None, :] ** 2
    wanted = np.mean(np.exp(2j * np.pi * 20e-6 * np.sqrt(square)))
    assert abs(found - wanted) < 2e-3 * abs(wanted)  # 64 frequencies


def test_between_the_axes_switches_neither_kernel_alone_is_right_and_the_mixed_one_is():
    # Three times the beams, side by side: switches at 5 and 21 mm. In a window of 300 rows both are beyond 10 mm.
    start = torch.cat([beams((96, 130))] * 3, dim=1)
    keys = {"pitch_m": PITCH, "wavelength_m": WAVELENGTH, "distance_m": 10e-3}
    higher = torch.nn.functional.pad(start, (0, 0, 102, 102))
    wanted = angular_spectrum(higher, **keys)[102:-102].numpy()
    assert relative(propagate(start, **keys).numpy(), wanted) < 1e-6
    assert relative(angular_spectrum(start, **keys).numpy(), wanted) > 1e-4
    assert relative(impulse_response(start, **keys).numpy(), wanted) > 1e-4


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
@pytest.mark.parametrize("z", [0.3e-3, 3e-3, 80e-3])
def test_the_way_back_is_the_adjoint_by_sign_and_by_method(dtype, z):
    a, b = noise((2, 29, 130), dtype, 1), noise((2, 29, 130), dtype, 2)
    keys = {"pitch_m": (PITCH, 3e-6), "wavelength_m": WAVELENGTH}
    there, back = (Propagator.prepare(a.shape, distance_m=s * z, like=a, **keys) for s in (1, -1))
    left = torch.vdot(b.flatten(), there.forward(a).flatten())
    right = torch.vdot(there.adjoint(b).flatten(), a.flatten())
    rounding = 2e-6 if dtype == torch.complex64 else 1e-14
    size = float(torch.linalg.vector_norm(a)) * float(torch.linalg.vector_norm(b))
    assert abs(complex(left - right)) < rounding * size
    assert torch.equal(there.adjoint(b), back.forward(b))


@pytest.mark.parametrize("z", [1e-6, 3e-5, 1e-3, 0.1, 10.0, 1e4, -1e4])
@pytest.mark.parametrize("pitch", [0.2e-6, PITCH, 1e-4])
@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
@pytest.mark.filterwarnings("ignore::holocal.errors.SamplingWarning")
def test_from_a_micrometre_to_ten_kilometres_everything_is_finite(z, pitch, dtype):
    out = propagate(noise((1, 6, 11), dtype), pitch_m=pitch, wavelength_m=WAVELENGTH, distance_m=z)
    assert out.dtype == dtype
    assert out.shape == (1, 6, 11)
    assert bool(torch.isfinite(torch.view_as_real(out)).all())
    assert float(out.abs().max()) > 0


def test_ten_kilometres_keep_the_phase_of_exact_arithmetic():
    getcontext().prec = 60
    wavelength, pitch, z = (Decimal.from_float(size) for size in (WAVELENGTH, 1e-3, 1e4))
    start = torch.zeros((3, 201), dtype=torch.complex128)
    start[0, 0] = 1
    found = propagate(start, pitch_m=1e-3, wavelength_m=WAVELENGTH, distance_m=1e4).numpy()
    for row, column in ((0, 0), (2, 77), (1, 200)):
        r = ((row * pitch) ** 2 + (column * pitch) ** 2 + z**2).sqrt()
        turns = float(r / wavelength % 1)
        # exp(ikr) / (i lambda r): what the kernel has more is 1 / kr = 1e-11. In float64, k r alone is 2e-5 rad wrong.
        wanted = 1e-6 / (1j * WAVELENGTH * 1e4) * np.exp(2j * np.pi * turns)
        assert abs(found[row, column] - wanted) < 1e-9 * abs(wanted)


def test_no_distance_changes_nothing_and_an_infinite_one_is_named_the_far_field():
    start = noise((5, 7))
    keys = {"pitch_m": PITCH, "wavelength_m": WAVELENGTH}
    out = propagate(start, distance_m=0.0, **keys)
    assert torch.equal(out, start)
    assert out.data_ptr() != start.data_ptr()
    assert torch.allclose(Propagator.prepare((5, 7), distance_m=0.0, like=start, **keys).forward(start), start)
    for z in (np.inf, -np.inf, np.nan):
        with pytest.raises(UsageError, match="far field is the Fourier transform"):
            propagate(start, distance_m=z, **keys)


def test_what_is_no_field_and_no_pitch_is_refused():
    keys = {"wavelength_m": WAVELENGTH, "distance_m": 1e-3}
    with pytest.raises(UsageError, match="complex64 or complex128"):
        propagate(torch.ones((4, 4)), pitch_m=PITCH, **keys)
    with pytest.raises(UsageError, match="no light"):
        propagate(noise((4, 0)), pitch_m=PITCH, **keys)
    for pitch in (0.0, -PITCH, np.nan, np.inf, (PITCH, 0.0)):
        with pytest.raises(SamplingError, match="finite and above 0"):
            propagate(noise((4, 4)), pitch_m=pitch, **keys)
    prepared = Propagator.prepare((4, 4), pitch_m=PITCH, **keys)
    for wrong in (noise((4, 5), torch.complex64), noise((4, 4))):
        with pytest.raises(UsageError, match="Prepare a propagator like this field"):
            prepared.forward(wrong)


def test_light_that_the_samples_do_not_determine_is_warned_of_and_other_light_is_not():
    n = 128
    disc, coarse = soft_disc(n, 30), noise((n, n))
    hard = (soft_disc(n, 30).real > 0.5).to(torch.complex128)
    keys = {"pitch_m": PITCH, "wavelength_m": WAVELENGTH}
    limit = critical_distance((n, n), **keys)
    for doubtful in (coarse, hard, torch.stack([disc, coarse])):
        with pytest.warns(SamplingWarning, match="between the samples decides"):
            propagate(doubtful, distance_m=0.3 * limit, **keys)
    with pytest.warns(SamplingWarning, match="is evanescent"):
        propagate(coarse, pitch_m=0.2e-6, wavelength_m=WAVELENGTH, distance_m=0.3e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for good, z in ((disc, 0.3 * limit), (disc, 1e-6), (coarse, 1.01 * limit), (hard, limit), (0 * disc, 1e-3)):
            propagate(good, distance_m=z, **keys)


@pytest.mark.parametrize("shape", [(1, 1), (33, 47), (3, 2, 64, 40), (700, 90)])
@pytest.mark.parametrize("adjoint", [False, True])
def test_the_convolution_in_blocks_is_the_plain_one(shape, adjoint):
    field, quadrant = noise(shape), noise((2 * shape[-2] + 5, shape[-1] + 3), seed=1)
    found, plain = (f(field, quadrant, adjoint=adjoint) for f in (convolve, convolve_plainly))
    assert relative(found.numpy(), plain.numpy()) < 1e-14
    view = field.conj().mT.contiguous().mT  # neither rows nor signs as stored
    plain = convolve_plainly(field.conj().resolve_conj(), quadrant, adjoint=adjoint)
    assert relative(convolve(view, quadrant, adjoint=adjoint).numpy(), plain.numpy()) < 1e-14


def test_gradients_go_through_propagation():
    start = noise((2, 2, 3)).requires_grad_()
    free_space = Propagator.prepare((2, 3), pitch_m=PITCH, wavelength_m=WAVELENGTH, distance_m=1e-3, like=start)
    assert torch.autograd.gradcheck(free_space.forward, (start,))
    assert torch.autograd.gradcheck(free_space.adjoint, (start,))


def test_the_field_that_is_given_is_left_as_it_was():
    start = noise((2, 20, 30))
    before = start.clone()
    propagate(start, pitch_m=PITCH, wavelength_m=WAVELENGTH, distance_m=20e-3)
    assert torch.equal(start, before)


def test_light_near_the_sampling_limit_is_doubted_only_where_its_other_order_meets_the_window():
    n = 160
    x = (np.arange(n) - (n - 1) / 2)[None, :]
    beam = np.exp(-(x**2 + x.T**2) / 30**2 + 2j * np.pi * 0.47 * x)  # order -1 is at 0.53 cycles per pixel
    keys = {"pitch_m": PITCH, "wavelength_m": WAVELENGTH}
    limit = critical_distance((n, n), **keys)
    propagate(torch.from_numpy(beam), distance_m=0.99 * limit, **keys)  # it goes 0.53 0.99 / 0.5 n pixels sideways
    with pytest.warns(SamplingWarning, match="along x"):
        propagate(torch.from_numpy(beam), distance_m=0.8 * limit, **keys)


def test_the_band_limit_of_a_wide_window_lets_light_go_further_along_rows_than_along_columns():
    y, x = ((31.5 - np.arange(64))[:, None], (np.arange(200) - 99.5)[None, :])
    # 0.3 cycles per pixel move 133 px in 12 mm: more than half the padded rows, 64, less than half the columns, 200.
    envelope = np.exp(-((x + 60) ** 2 + y**2) / 9**2)
    sideways, upwards = (envelope * np.exp(0.6j * np.pi * u) for u in (x + 0 * y, y + 0 * x))
    keys = {"pitch_m": PITCH, "wavelength_m": WAVELENGTH, "distance_m": 12e-3}
    kept, lost = (angular_spectrum(torch.from_numpy(beam), **keys).abs().square().sum() for beam in (sideways, upwards))
    assert float(kept) > 0.8 * float(np.sum(envelope**2))  # all but what spreads over the top and the bottom
    assert float(lost) < 1e-4 * float(np.sum(envelope**2))
