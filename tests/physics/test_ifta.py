"""Windowed transforms and the IFTA against full transforms in float64; what it reports; zeros, odd sizes, threads."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holocal.hologram.encode import blocks, fourier
from holocal.hologram.encode import ifta as ifta_module
from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.ifta import ifta, unit_modulus


def random_field(rows, columns, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy((rng.normal(size=(rows, columns)) + 1j * rng.normal(size=(rows, columns))).astype("c8"))


def ellipse(transform, rx, ry):
    fx, fy = transform.frequencies(1.0, 1.0)
    return torch.from_numpy(np.hypot(fx[None, :] / rx, fy[:, None] / ry) <= 1)


def encode_in_full(start, wanted, inside, *, iterations, relaxation, momentum):
    """Return the field and the errors of the same algorithm, by whole transforms in float64."""
    unit = lambda x: np.where(x == 0, 0, x / np.maximum(np.abs(x), 1e-30))  # noqa: E731
    field, change, errors = unit(start), np.zeros_like(start), []
    wanted = np.where(inside, wanted, 0)
    for step in range(iterations + 1):
        found = np.where(inside, np.fft.fft2(field, norm="ortho"), 0)
        scale = np.vdot(wanted, found).real / np.vdot(wanted, wanted).real
        errors.append(np.linalg.norm(found - scale * wanted) / np.linalg.norm(scale * wanted))
        if step < iterations:
            change = momentum * change + relaxation * (scale * wanted - found)
            field = unit(field + np.fft.ifft2(change, norm="ortho"))
    return field, errors


def spread(compact, transform):
    """Return a compact array at its place in the full spectrum, zero elsewhere."""
    ky, kx = transform.reach_rows, transform.reach_columns
    full = np.zeros((transform.rows, transform.columns), compact.numpy().dtype)
    full[np.ix_(np.r_[0 : ky + 1, -ky:0], np.r_[0 : kx + 1, -kx:0])] = compact.numpy()
    return full


SIZES = [(40, 64, 9, 20), (41, 37, 20, 18), (200, 30, 0, 5), (1, 16, 3, 3), (17, 1, 4, 4), (1, 1, 0, 0)]


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


def test_update_is_add_constrain_and_transform(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 1000)  # several blocks of rows and of columns
    transform = WindowedTransform(230, 50, 30, 12)
    data, spectrum = random_field(230, 50, 3), random_field(61, 25, 4)
    wanted = unit_modulus(data + transform.adjoint(spectrum))
    given, out = spectrum.clone(), torch.empty_like(spectrum)
    found = transform.update(data, spectrum, unit_modulus, out=out)
    assert found is out
    assert torch.equal(spectrum, given)
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


@pytest.mark.parametrize(("rows", "columns"), [(60, 80), (61, 47), (53, 96), (1, 64), (67, 1), (45, 45)], ids=str)
@pytest.mark.parametrize("share", [0.22, 0.8], ids=["over-relaxed", "crowded window"])
def test_the_ifta_is_the_same_as_by_whole_transforms_in_double_precision(rows, columns, share, monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 500)
    # a half-axis for the share of the band; a single line has one dimension less
    half = share / 2 if 1 in (rows, columns) else np.sqrt(share) / 2
    transform = WindowedTransform(rows, columns, int(half * rows), int(half * columns))
    window = ellipse(transform, 1, 1)  # the whole rectangle, but for some bins
    window[:, 2:3] = False
    wanted = random_field(*transform.shape, 11)
    start = transform.adjoint(wanted * window)
    crowded = int(window.sum()) > 0.5 * rows * columns
    pace = {"relaxation": 1.0, "momentum": 0.0} if crowded else {"relaxation": 1.8, "momentum": 0.2}
    inside = spread(window, transform)
    field, errors = encode_in_full(
        start.numpy().astype(complex), spread(wanted, transform), inside, iterations=3, **pace
    )
    result = ifta(start, wanted, window, transform, iterations=3, gain=-np.inf)
    assert np.allclose(result.signal_error, errors, rtol=1e-4, atol=1e-5)
    # single precision; a pixel of small modulus before the division has a less certain phase
    assert np.median(np.abs(result.field.numpy() - field)) < 2e-6
    assert np.abs(result.field.numpy() - field).max() < 2e-3


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


def encoded(iterations, seed=5, **choices):
    transform = WindowedTransform(96, 128, 20, 24)
    window = ellipse(transform, 0.18, 0.2)
    wanted = random_field(*window.shape, seed) * window
    start = transform.adjoint(wanted)
    return ifta(start, wanted, window, transform, iterations=iterations, **choices), wanted, window, transform


def test_no_iteration_keeps_the_holograms_own_phase():
    result, wanted, _, transform = encoded(0)
    assert torch.allclose(torch.angle(result.field * transform.adjoint(wanted).conj()), torch.zeros(96, 128), atol=1e-4)


def test_ten_iterations_leave_less_error_than_twenty_of_the_plain_algorithm():
    result, wanted, window, transform = encoded(10)
    start = transform.adjoint(wanted).numpy().astype(complex)
    _, plain = encode_in_full(
        start, spread(wanted, transform), spread(window, transform), iterations=20, relaxation=1.0, momentum=0.0
    )
    assert result.signal_error[0] == pytest.approx(plain[0], rel=1e-4)
    assert result.signal_error[10] < plain[20]


def test_a_window_over_the_whole_band_leaves_no_freedom_and_stops():
    # Then each iteration can only give back the phase of the wanted field: the error stays where it was.
    transform = WindowedTransform(45, 63, 22, 31)
    window = torch.ones((45, 63), dtype=torch.bool)
    wanted = random_field(45, 63, 6)
    result = ifta(transform.adjoint(wanted), wanted, window, transform, iterations=50)
    assert result.iterations == 2
    assert len(result.signal_error) == 3
    assert result.stopped.startswith("iteration 2 ")
    assert max(result.signal_error) - min(result.signal_error) < 1e-3
    # a circular Gaussian field's own phase has the efficiency pi / 4
    assert result.efficiency == pytest.approx(np.pi / 4, abs=0.02)


def test_iterations_stop_at_the_first_that_takes_off_too_little():
    long, *_ = encoded(60, gain=0.0)
    assert (long.iterations, long.stopped) == (60, "")
    gains = 1 - np.array(long.signal_error[1:]) / np.array(long.signal_error[:-1])
    last = int(np.argmax(gains[1:] < 0.05)) + 2
    short, *_ = encoded(60, gain=0.05)
    assert short.iterations == last < 30
    assert short.signal_error == long.signal_error[: last + 1]
    assert short.stopped == f"iteration {last} took off {gains[last - 1]:.2%} of the error, less than 5.00%"


def test_a_warm_start_saves_iterations_when_the_scene_changes_a_little():
    cold, wanted, window, transform = encoded(10)
    changed = wanted + 0.1 * random_field(*wanted.shape, 8) * window  # 10 % of the wanted field's own size
    alone = ifta(transform.adjoint(changed), changed, window, transform, iterations=10)
    warm = ifta(cold.field, changed, window, transform, iterations=10)
    assert warm.signal_error[0] < 0.5 * alone.signal_error[0]
    assert warm.signal_error[4] < alone.signal_error[10]
    assert warm.efficiency > 0.9 * alone.efficiency


def test_a_warm_start_of_the_same_scene_goes_on_where_the_last_one_ended():
    cold, wanted, window, transform = encoded(10)
    warm = ifta(cold.field.clone(), wanted, window, transform, iterations=2)
    assert warm.signal_error[0] == pytest.approx(cold.signal_error[-1], rel=1e-3)
    assert warm.signal_error[2] < warm.signal_error[0]


@pytest.mark.parametrize("kind", ["hardly related", "opposite", "zero"])
def test_a_start_that_does_not_fit_is_given_up_for_the_holograms_own_phase(kind):
    own, wanted, window, transform = encoded(4)
    size = float(wanted.abs().square().sum() / own.field.numel()) ** 0.5
    starts = {
        "hardly related": transform.adjoint(wanted) + 3 * size * random_field(96, 128, 9),
        "opposite": -own.field,
        "zero": torch.zeros_like(own.field),
    }
    beyond = random_field(*window.shape, 10) * ~window  # not asked for
    result = ifta(starts[kind], wanted + beyond, window, transform, iterations=4)
    assert torch.equal(result.field, own.field)
    assert result.signal_error == own.signal_error
    assert result.stopped.startswith("the start left an error of ")
    assert "given up" in result.stopped


def test_where_nothing_is_wanted_nothing_is_claimed():
    transform = WindowedTransform(20, 30, 4, 5)
    window = ellipse(transform, 1, 1)
    dark = torch.zeros(transform.shape, dtype=torch.complex64)
    result = ifta(transform.adjoint(dark), dark, window, transform)
    assert result.stopped == "nothing is wanted in the window"
    assert (result.efficiency, result.in_window, result.signal_error, result.iterations) == (0, 0, (), 0)
    assert torch.isfinite(torch.view_as_real(result.field)).all()
    outside = random_field(*transform.shape)
    assert not ifta(transform.adjoint(outside), outside, window & False, transform).signal_error


def test_dark_pixels_of_the_start_take_part_and_leave_no_nan():
    transform = WindowedTransform(40, 50, 8, 9)
    window = ellipse(transform, 0.2, 0.2)
    wanted = random_field(*window.shape, 5) * window
    start = transform.adjoint(wanted)
    start[10:20] = 0
    result = ifta(start, wanted, window, transform, iterations=5)
    assert torch.allclose(result.field.abs(), torch.ones(40, 50), atol=1e-5)
    assert np.isfinite(result.signal_error).all()


@pytest.mark.parametrize("factor", [1e-25, 1e25])
def test_the_brightness_of_what_is_wanted_does_not_matter(factor):
    plain, wanted, window, transform = encoded(3)
    scaled = ifta(transform.adjoint(wanted), wanted * factor, window, transform, iterations=3)
    assert np.allclose(scaled.signal_error, plain.signal_error, rtol=1e-4)
    assert scaled.efficiency == pytest.approx(plain.efficiency, rel=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (11, 1), (2, 2), (13, 17)])
def test_a_field_of_any_size_keeps_unit_modulus(size):
    transform = WindowedTransform(*size, 2, 3)
    wanted = random_field(*transform.shape, 3)
    result = ifta(transform.adjoint(wanted), wanted, torch.ones(transform.shape, dtype=torch.bool), transform)
    assert torch.allclose(result.field.abs(), torch.ones(size), atol=1e-5)
    assert np.isfinite(result.signal_error).all()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_same_start_gives_the_same_bytes_in_any_number_of_threads(threads, monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 700)  # 20 blocks of rows, 7 of columns
    wanted = encoded(5)[0]
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    for _ in range(3):
        again = encoded(5)[0]
        assert torch.equal(again.field, wanted.field)
        assert again.signal_error == wanted.signal_error
        assert again.efficiency == wanted.efficiency


def test_tensors_as_an_accelerator_takes_them_give_the_same(monkeypatch):
    # the same calls on torch tensors, whole arrays at a time, torch's own FFT; without the accelerator
    numpy_way, *_ = encoded(5)
    for module in (blocks, fourier, ifta_module):
        monkeypatch.setattr(module, "lines", lambda data: data, raising=False)
    monkeypatch.setattr(fourier, "scratch", lambda shape, device: torch.empty(shape, dtype=torch.complex64))
    torch_way, *_ = encoded(5)
    assert np.allclose(torch_way.signal_error, numpy_way.signal_error, rtol=1e-4)
    assert float((torch_way.field - numpy_way.field).abs().median()) < 1e-5


def test_blocks_cover_every_line_once_and_pass_on_what_is_raised(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    seen = np.zeros(103, int)

    def count(part):
        seen[part] += 1

    blocks.in_blocks(count, 103, 10)
    assert (seen == 1).all()

    def refuse(part):
        if part.start == 50:
            raise ValueError("line 50")

    with pytest.raises(ValueError, match="line 50"):
        blocks.in_blocks(refuse, 103, 10)
