"""Each float32 stage of the engine against the same sum in float64, taken term by term."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import InputError
from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.ifta import ifta, unit_modulus
from holocal.hologram.frame import panel_phase, phase_to_levels
from holocal.hologram.reference import reference_turns
from holocal.hologram.settings import HologramSettings, Warped
from holocal.hologram.warp import Depth
from holocal.hologram.warped import accurate_plan, inside_outline, pupil_mask, warped_plan
from holocal.hologram.warped_sum import patch_sums, phasor, to_panel
from holocal.optics.bench import Bench, Panel
from holocal.optics.series import Series

DEG = np.pi / 180
BASE = HologramSettings(Panel(64, 48, 3.74e-6), Bench(), 515e-9, (12 * DEG, 10 * DEG))
STEP = 2 * np.pi / 256


def points(settings, count, seed=0):
    rng = np.random.default_rng(seed)
    tangents = rng.uniform(-1, 1, (count, 2)) * np.tan(np.asarray(settings.fov_rad) / 2)
    return tangents, rng.normal(size=count) + 1j * rng.normal(size=count)


@pytest.mark.parametrize("tolerance", [1e-5, 4e-3])
@pytest.mark.parametrize("distance", [1e-6, 1e-3, 1.0, np.inf])
@pytest.mark.parametrize("size", [(64, 48), (1, 97), (480, 3)])
def test_the_patches_sums_are_their_bilinear_forms(size, distance, tolerance):
    chosen = replace(BASE, panel=Panel(*size, 3.74e-6))
    plan = warped_plan(chosen, Depth(1 / distance), accurate_plan(chosen).layout.cut)
    tangents, strengths = points(chosen, 40)
    grid = plan.layout.grid
    found = patch_sums(plan, tangents, tolerance=tolerance).on_grid(strengths.astype(np.complex64))
    wanted = np.zeros((grid.rows, grid.columns), complex)
    for form in plan.forms:
        rows, columns = form.patch.rows, form.patch.columns
        shown = inside_outline(tangents, form.seen)
        ub, g = form.warp.field.at(tangents[shown]), form.warp.coordinate.on_grid(grid.s_x[columns], grid.s_y[rows])
        a = form.warp.phase_rad.on_grid(grid.s_x[columns], grid.s_y[rows])
        for (u, v, b), strength in zip(ub, strengths[shown], strict=True):
            wanted[rows, columns] += strength * np.exp(1j * (a + b + u * g[..., 0] + v * g[..., 1]))
    # float32 holds phases u . g of some hundred radians to 3e-5; the transform's tolerance is an l2 norm
    assert np.linalg.norm(found - wanted) < (3 * tolerance + 1e-4) * np.linalg.norm(wanted)


@pytest.mark.parametrize("size", [(32, 24), (1, 17), (13, 1), (1, 1)])
def test_mask_and_transform_to_the_panel_are_their_sums_in_float64(size):
    chosen = replace(BASE, panel=Panel(*size, 3.74e-6), method=Warped(0.03))
    made = accurate_plan(chosen).layout
    rng = np.random.default_rng(0)
    shape = (made.grid.rows, made.grid.columns)
    field = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    there = to_panel(made, chosen.panel, tolerance=1e-5)
    mask = there.mask(3e-3, None)
    found = there.pixels(there.spectrum(field.astype(np.complex64), mask))
    full = np.fft.fft2(field) * pupil_mask(made, 3e-3).astype(complex) / field.size
    # only the frequencies kept: the mask is nothing beyond
    kept = np.zeros(shape, bool)
    kept[np.ix_(there.rows, there.columns)] = True
    u_x, u_y = made.grid.frequencies()
    s = made.sight.to_sight.on_grid(chosen.panel.x_m, chosen.panel.y_m).reshape(-1, 2)
    in_x = np.exp(1j * np.outer(s[:, 0] - made.grid.s_x[0], u_x))
    in_y = np.exp(1j * np.outer(s[:, 1] - made.grid.s_y[0], u_y))
    wanted = np.einsum("ny,yx,nx->n", in_y, np.where(kept, full, 0), in_x, optimize=True)
    # complex64 FFTs leave 1e-6, the transform 1e-5, float32 places of up to 2 pi another 1e-6 per frequency
    assert np.linalg.norm(found.ravel() - wanted) < 1e-4 * np.linalg.norm(wanted)


@given(st.floats(-1e9, 1e9), st.integers(1, 5))
@settings(deadline=None, max_examples=100, derandomize=True)
def test_phasors_of_large_phases_are_reduced_before_they_are_rounded(phase, count):
    found = phasor(np.full(count, phase))
    assert found.dtype == np.complex64
    # 1e9 rad are a float64 to 1e-7, the product with 1 / 2 pi rounds once more; float32 cosines to 2e-7
    assert np.abs(found - np.exp(1j * phase)).max() < 5e-7 + 4e-16 * abs(phase)


@pytest.mark.parametrize("size", [(1, 1), (1, 131), (131, 1), (37, 23), (64, 300)])
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e18])
def test_the_panels_phase_is_that_of_float64(size, scale):
    panel = Panel(*size, 3.74e-6)
    reference = reference_turns(replace(BASE, panel=panel))
    rng = np.random.default_rng(0)
    shape = (panel.height, panel.width)
    field = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * scale
    found = panel_phase(torch.from_numpy(field.astype(np.complex64)), reference, panel)
    fx, fy = panel.illumination_frequency_per_m
    light = fx * panel.x_m[None, :] + fy * panel.y_m[:, None]
    wanted = np.angle(field) + 2 * np.pi * (reference.on_grid(panel.x_m, panel.y_m) - light)
    assert found.dtype == np.float32
    assert np.all((found >= 0) & (found < np.float32(2 * np.pi)))
    # the reference is 4.6e5 turns: 1e-10 of a turn; float32 holds a turn to 4e-7 rad, a few times over
    assert np.abs(np.angle(np.exp(1j * (found - wanted)))).max() < 3e-6


def test_a_dark_pixel_has_a_phase_too():
    panel = Panel(3, 2, 4e-6)
    phase = panel_phase(torch.zeros((2, 3), dtype=torch.complex64), Series(np.zeros((1, 1)), (0, 0), (1, 1)), panel)
    assert np.all(np.isfinite(phase))


@pytest.mark.parametrize("turns", [0, 1, -1, 7, -1000, 1591])  # 1591 turns: 1e4 rad
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_levels_of_phases_many_turns_away_are_the_nearest(dtype, turns):
    phase = (np.linspace(-0.5, 255.5, 65537) * STEP + 2 * np.pi * turns).astype(dtype)
    levels = phase_to_levels(phase)
    error = np.abs(np.angle(np.exp(1j * (phase.astype(np.float64) - levels * STEP))))
    # float32 holds 1e4 rad to 1e-3, and the product with 256 / 2 pi rounds once more: 0.04 of a level
    assert error.max() <= STEP / 2 + 2 * np.finfo(dtype).eps * np.abs(phase).max() + 1e-12


def test_levels_at_the_borders_and_at_a_turns_end():
    border = (np.arange(256) + 0.5) * STEP
    below, above = np.nextafter(border, 0), np.nextafter(border, 10)
    for phases in (border, below, above):
        levels = phase_to_levels(phases)
        assert np.all((levels == np.arange(256)) | (levels == (np.arange(256) + 1) % 256))
    last = np.nextafter(np.float32(2 * np.pi), np.float32(0))
    assert phase_to_levels(np.array([last, 2 * np.pi, -1e-30, 0.0, -0.0, 1e-45], np.float32)).tolist() == [0] * 6


@pytest.mark.parametrize("shape", [(), (1,), (1, 1), (1, 13), (13, 1), (0, 4), (97, 61)])
def test_levels_keep_the_shape_of_their_phases(shape):
    assert phase_to_levels(np.zeros(shape, np.float32)).shape == shape


RESPONSES = {
    "not monotone": 2 * np.pi * np.arange(256) / 256 + 0.3 * np.sin(np.arange(256)),
    "less than a turn": 1.4 * np.pi * np.arange(256) / 255,
    "three turns": 6 * np.pi * np.arange(256) / 255,
    "backwards": -2 * np.pi * np.arange(256) / 256,
    "far away": 1e4 + 2 * np.pi * np.arange(256) / 256,
    "constant": np.full(256, 0.7),
}


@pytest.mark.parametrize("name", RESPONSES)
def test_through_any_response_the_nearest_reachable_phase_is_chosen(name):
    response = RESPONSES[name]
    phase = np.random.default_rng(0).uniform(-30, 30, (40, 50)).astype(np.float32)
    levels = phase_to_levels(phase, response)
    reached, best = (
        np.abs(np.angle(np.exp(1j * (phase[..., None].astype(float) - r)))).min(axis=-1)
        for r in (response[levels][..., None], response)
    )
    # phases are looked up in steps of 2 pi / 16384; float32 holds 30 rad to 4e-6
    assert np.all(reached <= best + 2 * np.pi / 16384 + 1e-5)


@pytest.mark.parametrize(
    "response",
    [np.full(256, np.nan), np.r_[np.arange(255), np.inf], np.zeros(0), np.zeros(255), np.zeros((256, 1)), 1.0],
)
def test_responses_with_holes_are_refused(response):
    with pytest.raises(InputError):
        phase_to_levels(np.zeros((2, 2), np.float32), response)


@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (64, 1), (61, 97), (2, 3), (211, 101)])
def test_the_encoders_error_and_share_are_those_of_float64(shape):
    transform = WindowedTransform(*shape, max(shape[0] // 4, 0), max(shape[1] // 4, 0))
    rng = np.random.default_rng(0)
    start = torch.from_numpy((rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64))
    wanted = transform.forward(start)
    window = torch.from_numpy(rng.random(transform.shape) < 0.8)
    window[0, 0] = True
    encoded = ifta(start.clone(), wanted, window, transform, iterations=5)
    field = encoded.field.numpy().astype(complex)
    assert np.abs(np.abs(field) - 1).max() < 1e-5
    reach_y, reach_x = transform.reach_rows, transform.reach_columns
    full = np.fft.fft2(field, norm="ortho")
    found = full[np.ix_(np.r_[0 : reach_y + 1, -reach_y:0], np.r_[0 : reach_x + 1, -reach_x:0])] * window.numpy()
    target = wanted.numpy().astype(complex) * window.numpy()
    scale = np.vdot(target, found).real / np.vdot(target, target).real
    error = np.linalg.norm(found - scale * target) / np.linalg.norm(scale * target)
    # float32 sums of the powers: good to an error of 1e-3
    assert encoded.signal_error[-1] == pytest.approx(error, abs=1e-3)
    assert encoded.efficiency == pytest.approx(scale**2 * np.linalg.norm(target) ** 2 / field.size, rel=1e-4)


@given(st.floats(-25, 18))
@settings(deadline=None, max_examples=30, derandomize=True)
def test_a_field_of_any_scale_has_modulus_one(exponent):
    field = torch.full((2, 3), (0.6 - 0.8j), dtype=torch.complex64) * 10.0**exponent
    assert np.abs(unit_modulus(field).numpy() - (0.6 - 0.8j)).max() < 1e-6
