"""Levels, response and packing (docs/contract.md 5)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from holocal.errors import InputError
from holocal.hologram.frame import pack_rgb, panel_phase, phase_to_levels, unpack_rgb
from holocal.optics.bench import Panel
from holocal.optics.series import Series

STEP = 2 * np.pi / 256


def test_level_l_stands_for_2_pi_l_over_256():
    assert phase_to_levels((np.arange(256) * STEP).astype(np.float32)).tolist() == list(range(256))


def test_the_nearest_level_is_taken_and_255_and_a_half_is_level_0():
    phase = np.array([0.49, 0.51, 255.49, 255.51, -0.51, 256.0, 300.2, -1000.0]) * STEP
    assert phase_to_levels(phase.astype(np.float32)).tolist() == [0, 1, 255, 0, 255, 0, 44, 24]


@given(st.floats(-50, 50))
def test_the_level_is_within_half_a_step_round_the_circle(phase):
    level = phase_to_levels(np.array([phase], np.float32))[0]
    error = np.angle(np.exp(1j * (phase - float(level) * STEP)))
    assert abs(error) <= STEP / 2 + 1e-5  # float32 holds 50 rad to 4e-6


def test_a_response_maps_phases_to_the_level_that_comes_nearest():
    response = 2.2 * np.pi * (np.arange(256) / 255) ** 1.5  # not linear, more than a turn
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (30, 40)).astype(np.float32)
    levels = phase_to_levels(phase, response)
    reached = np.abs(np.angle(np.exp(1j * (phase - response[levels]))))
    best = np.abs(np.angle(np.exp(1j * (phase[..., None] - response)))).min(axis=-1)
    assert np.all(reached <= best + 2 * np.pi / 16384)  # phases are looked up in steps of 2 pi / 16384


def test_an_ideal_response_given_as_a_table_changes_nothing():
    phase = np.random.default_rng(1).uniform(0, 2 * np.pi, (30, 40)).astype(np.float32)
    difference = phase_to_levels(phase, np.arange(256) * STEP).astype(int) - phase_to_levels(phase)
    assert np.mean(difference == 0) > 0.97  # within 2 pi / 32768 of the border between two levels either will do
    assert set(np.unique(difference % 256)) <= {0, 1, 255}


@pytest.mark.parametrize("count", [2, 16, 128])
def test_a_panel_of_fewer_levels_gets_no_level_beyond_its_last_and_the_nearest_within(count):
    response = 0.9 * 2 * np.pi * np.arange(count) / count  # short of a turn: the gap goes to both its ends
    phase = np.random.default_rng(3).uniform(-9, 9, (40, 50)).astype(np.float32)
    levels = phase_to_levels(phase, response)
    assert set(np.unique(levels)) == set(range(count))
    reached = np.abs(np.angle(np.exp(1j * (phase - response[levels]))))
    best = np.abs(np.angle(np.exp(1j * (phase[..., None] - response)))).min(axis=-1)
    assert np.all(reached <= best + 2 * np.pi / 16384 + 1e-5)  # the look-up's step; float32 holds 9 rad to 1e-6


@pytest.mark.parametrize("response", [np.zeros(255), np.full(256, np.nan), np.zeros((256, 2))])
def test_a_response_that_is_none_is_refused(response):
    with pytest.raises(InputError):
        phase_to_levels(np.zeros((2, 2), np.float32), response)


def test_levels_travel_in_red_with_nothing_in_green_and_blue():
    levels = np.random.default_rng(2).integers(0, 256, (5, 7), dtype=np.uint8)
    packed = pack_rgb(levels)
    assert packed.shape == (5, 7, 3)
    assert packed.dtype == np.uint8
    assert np.array_equal(packed[..., 0], levels)
    assert not packed[..., 1:].any()
    assert np.array_equal(unpack_rgb(packed), levels)


@pytest.mark.parametrize(
    "packed", [np.full((2, 2, 3), 7, np.uint8), np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3), np.uint16)]
)
def test_frames_that_were_not_packed_here_are_refused(packed):
    with pytest.raises(InputError):
        unpack_rgb(packed)


def test_the_linear_term_takes_the_illuminations_own_phase_away():
    # Panel phase plus illumination phase is the wanted phase: here 0 everywhere.
    panel = Panel(6, 300, 4e-6)  # more than one block of rows
    phase = panel_phase(torch.ones((300, 6), dtype=torch.complex64), Series(np.zeros((1, 1)), (0, 0), (1, 1)), panel)
    fx, fy = panel.illumination_frequency_per_m
    light = 2 * np.pi * (fx * panel.x_m[None, :] + fy * panel.y_m[:, None])
    assert np.abs(np.angle(np.exp(1j * (phase + light)))).max() < 1e-6
    # half an order spacing: neighbouring rows differ by half a turn
    assert np.allclose(np.abs(np.diff(phase[:, 0])), np.pi, atol=1e-6)


def test_the_reference_is_put_back():
    panel = Panel(5, 4, 4e-6)
    reference = Series(np.array([[0.1, 0.2], [0.3, 0.0]]), (0.0, 0.0), panel.half_size_m)
    field = torch.polar(torch.ones((4, 5)), torch.linspace(-3, 3, 20).reshape(4, 5))
    fx, fy = panel.illumination_frequency_per_m
    light = fx * panel.x_m[None, :] + fy * panel.y_m[:, None]
    wanted = 2 * np.pi * (reference.on_grid(panel.x_m, panel.y_m) - light) + torch.angle(field).numpy()
    error = panel_phase(field, reference, panel) - wanted
    assert np.abs(np.angle(np.exp(1j * error))).max() < 1e-6
