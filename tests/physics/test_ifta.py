"""Windowed transforms against torch's full ones; the IFTA keeps unit modulus and closes in on the wanted field."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.ifta import ifta, unit_modulus


def random_field(rows, columns, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy((rng.normal(size=(rows, columns)) + 1j * rng.normal(size=(rows, columns))).astype("c8"))


SIZES = [(40, 64, 9, 20), (41, 37, 20, 18), (200, 30, 0, 5), (1, 16, 3, 3)]


@pytest.mark.parametrize(("rows", "columns", "reach_rows", "reach_columns"), SIZES)
def test_the_windowed_transform_is_the_corner_of_the_full_one(rows, columns, reach_rows, reach_columns):
    transform = WindowedTransform(rows, columns, reach_rows, reach_columns)
    data = random_field(rows, columns)
    kept = data.clone()
    found = transform.forward(data)
    ky, kx = transform.reach_rows, transform.reach_columns
    full = torch.fft.fft2(data.to(torch.complex128), norm="ortho")
    wanted = full[np.ix_(np.r_[0 : ky + 1, -ky:0], np.r_[0 : kx + 1, -kx:0])]
    assert torch.allclose(found.to(torch.complex128), wanted, atol=3e-6)  # single precision
    assert torch.equal(data, kept)


@pytest.mark.parametrize(("rows", "columns", "reach_rows", "reach_columns"), SIZES)
def test_the_way_back_is_the_adjoint(rows, columns, reach_rows, reach_columns):
    transform = WindowedTransform(rows, columns, reach_rows, reach_columns)
    data = random_field(rows, columns, 1)
    spectrum = random_field(*transform.forward(data).shape, 2)
    left = torch.vdot(spectrum.flatten(), transform.forward(data).flatten())
    right = torch.vdot(transform.adjoint(spectrum).flatten(), data.flatten())
    assert abs(complex(left - right)) < 1e-5 * rows * columns


def test_update_is_add_constrain_and_transform():
    transform = WindowedTransform(230, 50, 30, 12)  # more than two blocks of rows
    data, spectrum = random_field(230, 50, 3), random_field(61, 25, 4)
    wanted = unit_modulus(data + transform.adjoint(spectrum))
    found = transform.update(data, spectrum, unit_modulus)
    assert torch.allclose(data, wanted, atol=1e-5)
    assert torch.allclose(found, transform.forward(wanted), atol=1e-4)


def test_frequencies_point_right_and_up():
    # exp(2 pi i f.x) on pixels whose rows run downwards has its peak at (fx, fy)
    transform = WindowedTransform(24, 40, 8, 15)
    fx, fy = transform.frequencies(2e-6, 3e-6)
    row, column = 5, len(fx) - 3
    x = (np.arange(40) - 19.5) * 2e-6
    y = (11.5 - np.arange(24)) * 3e-6
    wave = np.exp(2j * np.pi * (fx[column] * x[None, :] + fy[row] * y[:, None])).astype("c8")
    peak = transform.forward(torch.from_numpy(wave)).abs().argmax()
    assert np.unravel_index(int(peak), (17, 31)) == (row, column)


def test_unit_modulus_keeps_the_phase_and_leaves_zero_alone():
    data = random_field(6, 7)
    data[2, 3] = 0
    wanted = torch.angle(data)
    unit_modulus(data)
    assert complex(data[2, 3]) == 0
    data[2, 3] = 1
    assert torch.allclose(data.abs(), torch.ones(6, 7), atol=1e-6)
    assert torch.allclose(torch.angle(data), wanted.index_put((torch.tensor(2), torch.tensor(3)), torch.tensor(0.0)))


def encoded(iterations, seed=5):
    transform = WindowedTransform(96, 128, 20, 24)
    fx, fy = transform.frequencies(1.0, 1.0)
    window = torch.from_numpy(np.hypot(fx[None, :] / 0.18, fy[:, None] / 0.2) <= 1)
    wanted = random_field(*window.shape, seed) * window
    start = transform.adjoint(wanted)
    return ifta(start, wanted, window, transform, iterations=iterations), wanted, window, transform


def test_the_error_in_the_window_falls_at_every_iteration_and_the_modulus_stays_one():
    result, wanted, window, transform = encoded(10)
    assert len(result.signal_error) == 11
    assert np.all(np.diff(result.signal_error) < 0)
    assert result.signal_error[-1] < 0.5 * result.signal_error[0]
    assert torch.allclose(result.field.abs(), torch.ones(96, 128), atol=1e-5)
    # what is reported is what is there
    found = transform.forward(result.field) * window
    scale = float(
        torch.vdot(wanted.flatten(), found.flatten()).real / torch.vdot(wanted.flatten(), wanted.flatten()).real
    )
    error = float(torch.linalg.vector_norm(found - scale * wanted) / torch.linalg.vector_norm(scale * wanted))
    assert result.signal_error[-1] == pytest.approx(error, rel=1e-3)
    share = float(torch.linalg.vector_norm(found) ** 2) / (96 * 128)
    assert result.in_window == pytest.approx(share, rel=1e-3)
    assert result.efficiency == pytest.approx(
        scale**2 * float(torch.linalg.vector_norm(wanted) ** 2) / (96 * 128), rel=1e-3
    )
    assert 0.3 < result.efficiency < result.in_window < 1


def test_no_iteration_keeps_the_holograms_own_phase():
    result, wanted, _, transform = encoded(0)
    assert torch.allclose(torch.angle(result.field * transform.adjoint(wanted).conj()), torch.zeros(96, 128), atol=1e-4)


def test_a_window_over_the_whole_band_leaves_no_freedom():
    # Then each iteration can only give back the phase of the wanted field: the error stays where it was.
    transform = WindowedTransform(45, 63, 22, 31)
    window = torch.ones((45, 63), dtype=torch.bool)
    wanted = random_field(45, 63, 6)
    result = ifta(transform.adjoint(wanted), wanted, window, transform, iterations=4)
    assert max(result.signal_error) - min(result.signal_error) < 1e-3
    # a circular Gaussian field's own phase has the efficiency pi / 4
    assert result.efficiency == pytest.approx(np.pi / 4, abs=0.02)


def test_the_same_start_gives_the_same_bytes():
    assert torch.equal(encoded(5)[0].field, encoded(5)[0].field)
