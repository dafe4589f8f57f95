"""Rays of a pattern on any bench, and the pose that explains what is seen of them."""

from __future__ import annotations

import numpy as np
import pytest

from holocal.estimate.bench_pose import DISPLACEMENTS, bench_at, fit_pose
from holocal.optics.bench import Bench, Panel
from holocal.optics.panel_rays import landed, middles, panel_rays
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.records.facts import CameraFacts, RigFacts, SlmFacts
from procedures._aberration_spots import Recipe, spots_at
from procedures._bench_light import NUISANCE, PARAMETERS, LightModel, array_light, fit_light, moved_px, spot_data

GREEN = 515e-9
PANEL = Panel(960, 540, 3.74e-6)
OFF = np.array([-0.01, -0.08, -0.12, -0.29, 0.02, -0.15, 0.24, 0.37, -0.09, 0.36, 0.0, 0.35])  # degrees and mm
FIELD = np.array([[0.02, 0.01], [-0.03, 0.04], [0.05, -0.03]])
PLACES = np.stack(np.meshgrid(np.linspace(-1.2e-3, 1.2e-3, 5), np.linspace(-0.8e-3, 0.8e-3, 4)), axis=-1).reshape(-1, 2)


def phase_turns(bench: Bench, tangents: np.ndarray, places: np.ndarray) -> np.ndarray:
    found = exact_phase(bench, VirtualPoints.at(tangents), places[:, None], wavelength_m=GREEN)
    return found.phase_rad / (2 * np.pi)


def slopes(bench: Bench, tangents: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(places, points, 2) turns per metre, of the path lengths."""
    step = 2e-6
    return np.stack(
        [
            (phase_turns(bench, tangents, places + step * e) - phase_turns(bench, tangents, places - step * e))
            / (2 * step)
            for e in np.eye(2)
        ],
        axis=-1,
    )


def test_on_the_bench_that_a_pattern_was_made_for_every_ray_is_seen_in_its_direction():
    bench = Bench.nominal()
    rays = panel_rays(PLACES, slopes(bench, FIELD, PLACES), np.ones((len(PLACES), len(FIELD))), GREEN)
    at = landed(bench, rays)
    assert at.arrived.all()
    np.testing.assert_allclose(at.field_tan, np.repeat(FIELD, len(PLACES), axis=0), atol=2e-8)


def test_a_ray_of_a_misaligned_bench_has_the_slope_of_that_benchs_own_path_lengths():
    nominal, bench = Bench.nominal(), bench_at(Bench.nominal(), OFF)
    sent = slopes(nominal, FIELD, PLACES)
    at = landed(bench, panel_rays(PLACES, sent, np.ones((len(PLACES), len(FIELD))), GREEN))
    assert np.abs(at.field_tan - np.repeat(FIELD, len(PLACES), axis=0)).max() > 1e-3
    # a virtual point where the ray is seen asks that place of the panel for just the slope that the pattern has there
    for spot in range(len(FIELD)):
        seen = at.field_tan[spot * len(PLACES) : (spot + 1) * len(PLACES)]
        for place, tangent, wanted in zip(PLACES, seen, sent[:, spot], strict=True):
            found = slopes(bench, tangent[None], place[None])[0, 0]
            np.testing.assert_allclose(found, wanted, atol=1.0)  # of 267,000 turns per metre of a pixel


def test_the_middle_is_that_of_the_light_and_a_dark_spot_has_none():
    rays = panel_rays(PLACES, slopes(Bench.nominal(), FIELD, PLACES), np.ones((len(PLACES), len(FIELD))), GREEN)
    at = landed(bench_at(Bench.nominal(), OFF), rays)
    light = np.where(np.arange(len(rays.light)) >= 2 * len(PLACES), 0.0, 1.0)
    light[0] = 3.0
    found = middles(at, light, rays.first)
    first = at.field_tan[: len(PLACES)]
    np.testing.assert_allclose(found[0], (first.sum(axis=0) + 2 * first[0]) / (len(PLACES) + 2))
    np.testing.assert_allclose(found[1], at.field_tan[len(PLACES) : 2 * len(PLACES)].mean(axis=0))
    assert np.isnan(found[2]).all()


def test_a_straight_line_is_fitted_with_its_textbook_errors_and_an_outlier_counts_little():
    x = np.linspace(-1, 1, 41)
    rng = np.random.default_rng(3)
    measured = 0.3 + 0.7 * x + 0.01 * rng.standard_normal(41)
    measured[5], measured[20] = 5.0, np.nan
    found = fit_pose(lambda v: v[0] + v[1] * x, measured, np.full(41, 0.01), np.full(2, 10.0))
    np.testing.assert_allclose(found.values, [0.3, 0.7], atol=0.012)
    assert found.used.sum() == 40
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance))[0], 0.01 / np.sqrt(39), rtol=0.3)


def facts() -> RigFacts:
    field = np.radians(25.0)
    camera = CameraFacts(750, 750, (field, field), 4095, 1e-5, 1.0)
    return RigFacts("test", SlmFacts(3840, 2160, 3.74e-6), camera, (GREEN,), 3e-3, 12e-3, True)


@pytest.fixture(scope="module")
def lights():
    side = np.tan(np.radians(11.0)) * np.linspace(-1, 1, 9)
    arrays = [
        spots_at(facts(), GREEN, np.stack(np.meshgrid(side + shift, side - shift), axis=-1).reshape(-1, 2))
        for shift in (0.0, 0.01)
    ]
    recipes = [
        [Recipe(sign * 0.3, np.zeros(len(array.field_tan)), np.ones(len(array.field_tan))) for sign in (1.0, -1.0)]
        for array in arrays
    ]
    return [array_light(array, own) for array, own in zip(arrays, recipes, strict=True)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pose_and_beam_that_explain_the_spots_say_where_a_pictures_points_lie(lights, sign):
    rng = np.random.default_rng(5)
    truth = np.concatenate([[0.1, -0.1, -1.0, -0.5, 0.0, 0.0, 0.0, 0.0], sign * OFF])
    noise_px = 0.03
    middles_px, sigma = [], []
    for light in lights:
        places = LightModel(light.array, light.shown).places_px(truth).reshape(2, -1, 2)
        middles_px.append(places + noise_px * rng.standard_normal(places.shape))
        sigma.append(np.where(light.array.on, noise_px, np.nan))
    found = fit_light(spot_data(lights, middles_px, sigma))
    assert found.scale < 1.5
    for light in lights:
        on = light.array.on
        wanted, got = moved_px(light, truth)[on], moved_px(light, found.values)[on]
        assert np.sqrt(np.mean(wanted**2)) > 0.1  # without it the middles are off by a tenth of a pixel and more
        assert np.sqrt(np.mean((got - wanted) ** 2)) < 0.03
    well = ["mirror_dx_mm", "slm_rx_deg", "slm_ry_deg"]  # what spots alone tell; the rest is told by its sigma
    for name in PARAMETERS:
        k = PARAMETERS.index(name)
        sigma_k = np.sqrt(found.covariance[k, k])
        assert abs(found.values[k] - truth[k]) < 4 * sigma_k + 1e-3, name
        assert name not in well or sigma_k < 0.2, (name, sigma_k)


def test_parameters_are_the_beams_and_the_twelve_displacements():
    assert (*NUISANCE, *DISPLACEMENTS) == PARAMETERS
    assert DISPLACEMENTS[0] == "mirror_rx_deg"
    assert DISPLACEMENTS[-1] == "slm_dz_mm"
    bench = bench_at(Bench.nominal(), OFF)
    np.testing.assert_allclose(np.degrees(bench.slm.rotation_rad), OFF[6:9])
    np.testing.assert_allclose(np.array(bench.mirror.shift_m) * 1e3, OFF[3:6])
