"""The table of all levels from the phases of some; what a pattern sends through a blur; the sign from two pictures."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import generator, speckle

from holocal.estimate.fringes import UNKNOWN_RAD, Fringes
from holocal.estimate.registration import blob_image
from holocal.estimate.response import interpolate_response, next_levels, nominal_table, phase_difference, rms
from procedures._response_patterns import MEASURED, VERIFIED, pattern
from procedures._response_picture import TELLING, likeness

LEVEL = np.arange(256) / 255
SMOOTH = 0.88 * 2 * np.pi * (LEVEL + 0.07 * np.sin(2 * np.pi * LEVEL))
KINKED = np.interp(LEVEL, [0, 0.2, 0.5, 0.8, 1], [0, 0.2, 2.2, 4.6, 5.2])
GRID = np.linspace(0, 255, 36).round().astype(np.int64)


def measured(table, levels, sigma_rad, seed=0, valid=True):
    error = sigma_rad * generator(seed).normal(size=len(levels))
    error[0] = 0.0
    covariance = sigma_rad**2 * np.diag((np.arange(len(levels)) > 0).astype(float))
    phase = table[levels] - table[0] + error
    return Fringes(levels, phase, covariance, np.ones(1), np.zeros((3, 1)), np.ones(1, bool), 1.0, valid)


def error_of(found, table):
    return phase_difference(found.phase_rad, table)


@pytest.mark.parametrize(
    ("table", "limit"),
    [(SMOOTH, 0.003), (1.5 * 2 * np.pi * LEVEL**1.4, 0.003), (KINKED, 0.005), (-SMOOTH, 0.003)],
    ids=["smooth", "long", "kinked", "falling"],
)
def test_levels_between_measured_ones_are_interpolated_within_the_error_given(table, limit):
    found = interpolate_response(measured(table, GRID, 0.002), 256)
    assert found.valid
    assert found.phase_rad[0] == 0.0
    assert rms(error_of(found, table)) < limit  # 0.002 rad per level, averaged; a kink is missed by 0.03 at its tip
    assert rms(error_of(found, table)) < 1.5 * found.sigma_rms_rad
    assert found.range_rad == pytest.approx(table[-1] - table[0], abs=0.01)


def test_the_errors_given_are_those_made_on_average():
    found = [interpolate_response(measured(SMOOTH, GRID, 0.01, seed), 256) for seed in range(20)]
    made = np.mean([np.mean(error_of(one, SMOOTH) ** 2) for one in found])
    # a smooth curve has some ten free values per table: 20 tables scatter by sqrt(2 / 200) = 10 %; the smoothness is
    # not known but chosen, to about a factor of two of the error squared
    assert 0.4 < made / np.mean([one.sigma_rms_rad**2 for one in found]) < 1.6


def test_levels_that_lie_off_any_curve_are_owned_up_to():
    rough = SMOOTH + 0.02 * generator(1).normal(size=256)
    found = interpolate_response(measured(rough, GRID, 0.001), 256)
    assert rms(error_of(found, rough)) < 1.3 * found.sigma_rms_rad
    assert rms(error_of(found, rough) / found.sigma_rad) < 1.6


@pytest.mark.parametrize("count", [8, 16, 64, 256])
def test_a_panel_of_few_levels_gets_a_table_of_as_many(count):
    table = 5.5 * np.arange(count) / count
    levels = np.unique(np.linspace(0, count - 1, 20).round().astype(np.int64))
    found = interpolate_response(measured(table, levels, 0.001), count)
    assert found.phase_rad.shape == found.sigma_rad.shape == (count,)
    assert rms(error_of(found, table)) < 0.003  # three times the error of a phase


def test_phases_that_are_not_valid_give_no_table_but_the_nominal_one_with_no_knowledge():
    found = interpolate_response(measured(SMOOTH, GRID, 0.01, valid=False), 256)
    assert not found.valid
    np.testing.assert_array_equal(found.phase_rad, nominal_table(256))
    assert np.all(found.sigma_rad == UNKNOWN_RAD)


def test_levels_are_measured_next_where_the_curve_bends():
    levels = np.linspace(0, 255, 16).round().astype(np.int64)
    bent = np.where(LEVEL < 0.7, 0.2 * LEVEL, 0.14 + 18 * (LEVEL - 0.7))  # one kink, at level 178.5
    chosen = next_levels(interpolate_response(measured(bent, levels, 1e-3), 256), levels, 4)
    assert len(set(chosen) - set(levels)) == 4
    assert np.abs(chosen - 178.5).min() < 10  # in the gap of 17 levels that holds it


def test_where_every_level_is_measured_the_least_known_come_again():
    levels = np.arange(8)
    chosen = next_levels(interpolate_response(measured(5.5 * np.arange(8) / 8, levels, 0.01), 8), levels, 5)
    assert len(set(chosen)) == 5
    assert set(chosen) <= set(levels)


def test_a_difference_of_phases_knows_no_piston_and_no_turn():
    turns = 2 * np.pi * np.arange(256)
    difference = phase_difference(SMOOTH + 1.7 + turns, SMOOTH + 0.1 * (LEVEL - LEVEL.mean()))
    np.testing.assert_allclose(difference, -0.1 * (LEVEL - LEVEL.mean()), atol=1e-9)


@pytest.mark.parametrize(("period", "scale"), [(VERIFIED, 4), (MEASURED, 3)])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.12])
def test_rows_of_two_and_three_keep_two_phases_through_a_blur_and_scale_their_difference(period, scale, share):
    rows = (np.arange(60) % period < period // 2).astype(float)
    blurred = (1 - 2 * share) * rows + share * (np.roll(rows, 1) + np.roll(rows, -1))
    assert len(np.unique(blurred.round(9))) == 2
    assert np.ptp(blurred) == pytest.approx(1 - scale * share)


@pytest.mark.parametrize("period", [VERIFIED, MEASURED])
def test_frames_of_a_pattern_differ_in_the_level_only_and_the_rest_is_random_but_fixed(period):
    one = pattern(135, 241, count=256, period=period, seed=(1, 0))
    low, high = one.levels(3), one.levels(250)
    assert low.shape == (135, 241)
    assert np.all((low == 3)[one.on] & (high == 250)[one.on])
    assert np.array_equal(low[~one.on], high[~one.on])
    assert 0.3 < one.on.mean() < 0.7
    assert len(np.unique(one.fixed)) > 200
    again, other = (pattern(135, 241, count=256, period=period, seed=seed) for seed in ((1, 0), (2, 0)))
    assert np.array_equal(again.levels(9), low * (~one.on) + 9 * one.on)
    assert np.mean(other.on == one.on) < 0.7


@pytest.mark.parametrize("bits", [3, 6])
def test_a_pattern_stays_within_the_panels_levels(bits):
    assert pattern(64, 64, count=2**bits, period=3, seed=(0,)).fixed.max() == 2**bits - 1


def _grains(rng):
    return speckle(rng, 300, 400, contrast=0.5, grain_px=2.0)


def test_blobs_are_known_by_their_likeness_wherever_the_bench_puts_them():
    rng = generator(2)
    blobs = blob_image(300, 400) * _grains(rng)
    moved = np.roll(blobs, (-14, 25), axis=(0, 1)) + 0.05 * rng.random((300, 400))
    noise = _grains(rng)
    assert likeness(moved) > likeness(noise) + 2 * TELLING
    assert abs(likeness(noise) - likeness(_grains(rng))) < TELLING
    assert likeness(np.zeros((300, 400))) == 0.0
