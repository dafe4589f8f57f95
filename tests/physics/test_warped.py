"""The warped engine against exact phase functions: accuracy asked and got, footprints, depths, views, skipped work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from random_points import cloud

from holocal.errors import SamplingError
from holocal.hologram import direct, synthesis
from holocal.hologram.clock import Clock
from holocal.hologram.depths import depth_bins
from holocal.hologram.direct import direct_hologram, direct_sum
from holocal.hologram.footprint import transmission
from holocal.hologram.pipeline import HologramSettings
from holocal.hologram.reference import reference_turns
from holocal.hologram.scenes.points import Aperture, PointCloud
from holocal.hologram.settings import Direct, Warped
from holocal.hologram.sight import sight, sight_of
from holocal.hologram.synthesis import synthesise
from holocal.hologram.warp import Depth
from holocal.hologram.warped import accurate_plan, inside_outline, warped_plan
from holocal.hologram.wavefront import Wavefront
from holocal.hologram.wavefront_error import patch_wavefront_errors
from holocal.optics.bench import Bench, Panel, Pose
from holocal.optics.phase_function import VirtualPoints, exact_phase

DEG = np.pi / 180
FULL = HologramSettings(Panel(3840, 2160, 3.74e-6), Bench(), 515e-9, (25 * DEG, 25 * DEG))
# as large a panel in a quarter of the pixels each way: the same optics, a sixteenth of the work
COARSE = replace(FULL, panel=Panel(960, 540, 4 * 3.74e-6), fov_rad=(6 * DEG, 5 * DEG))
SMALL = replace(FULL, panel=Panel(960, 540, 3.74e-6), fov_rad=(12 * DEG, 10 * DEG))
MISALIGNED = Bench(mirror=Pose((0.3 * DEG, -0.2 * DEG, 0.3 * DEG), (3e-4, -2e-4, 3e-4)))


@pytest.fixture(autouse=True)
def by_patches(monkeypatch):
    """However few the points: a scene of a handful would be summed point by point."""
    monkeypatch.setattr(synthesis, "_FEW", 0)


def field_of(clouds, settings):
    return synthesise(clouds, settings, reach=(10**6, 10**6), clock=Clock.start()).field.numpy()


def some_pixels(panel, count, seed=1):
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(0, panel.height, count), rng.integers(0, panel.width, count)
    return rows, columns, np.stack([panel.x_m[columns], panel.y_m[rows]], axis=-1)


def relative_error(clouds, settings, pixels=400):
    rows, columns, slm = some_pixels(settings.panel, pixels)
    exact = direct_sum(settings, clouds, slm)
    return np.linalg.norm(field_of(clouds, settings)[rows, columns] - exact) / np.linalg.norm(exact)


@pytest.mark.parametrize("accuracy", [0.3, 0.1, 0.03])
@pytest.mark.parametrize(
    "settings",
    [SMALL, replace(SMALL, wavelength_m=473e-9), replace(SMALL, bench=MISALIGNED, gaze_rad=(0.1, 0.05))],
    ids=["nominal", "blue", "misaligned, gaze aside"],
)
def test_the_error_against_the_direct_sum_is_below_the_one_asked_for(settings, accuracy):
    chosen = replace(settings, method=Warped(accuracy))
    assert relative_error([cloud(chosen, 60)], chosen) < accuracy


@pytest.mark.slow
@pytest.mark.parametrize("accuracy", [0.3, 0.1, 0.03])
def test_the_error_at_4k_is_below_the_one_asked_for(accuracy):
    settings = replace(FULL, method=Warped(accuracy))
    assert relative_error([cloud(settings, 300)], settings) < accuracy


def test_the_table_of_errors_is_of_the_settings_depth():
    settings = replace(COARSE, depth_m=0.4, method=Warped(0.1))
    assert np.nanmax(patch_wavefront_errors(settings, samples=5)) < 0.1  # the plan for infinity is 9 rad off there


@pytest.mark.parametrize("depth", [Depth(0.0), Depth(4.0), Depth(4.0, flat=True)], ids=["far", "25 cm", "25 cm, flat"])
@pytest.mark.parametrize("settings", [FULL, replace(FULL, bench=MISALIGNED, gaze_rad=(0.1, 0.05))])
def test_patches_leave_less_than_the_accuracy_of_every_points_phase(settings, depth):
    plan = warped_plan(settings, depth, accurate_plan(settings).layout.cut)
    rng, squares = np.random.default_rng(0), []
    limit = np.tan(np.asarray(settings.fov_rad) / 2)
    for form in plan.forms:
        box = form.patch.box
        s = box.centre + box.half * rng.uniform(-1, 1, (150, 2))
        low, high = np.maximum(form.seen.min(axis=0), -limit), np.minimum(form.seen.max(axis=0), limit)
        tangents = rng.uniform(low, high, (40, 2))
        slm = plan.layout.sight.panel(s)
        exact = exact_phase(
            settings.bench, depth.points(tangents[:, None]), slm, wavelength_m=515e-9, gaze_rad=settings.gaze_rad
        )
        seen = np.linalg.norm(exact.pupil_m, axis=-1) <= settings.bench.pupil_diameter_m / 2
        ub = form.warp.field.at(tangents)
        found = form.warp.phase_rad.at(s) + ub[:, 2:] + ub[:, :2] @ form.warp.coordinate.at(s).T
        squares.append((found + plan.layout.sight.reference_rad(s) - exact.phase_rad)[seen] ** 2)
    error = np.sqrt(np.mean(np.concatenate(squares)))  # nothing removed: piston and tilt count too
    assert error < 0.1
    assert error == pytest.approx(plan.error_rad, rel=0.25)  # the plan knows its own error


@pytest.mark.parametrize("tangent", [(0.0, 0.0), (0.05, -0.03), (-0.12, 0.04)])
def test_a_points_light_lies_in_its_footprint_and_fills_it(tangent):
    settings = replace(COARSE, fov_rad=(25 * DEG, 25 * DEG), panel=Panel(1920, 1080, 2 * 3.74e-6))
    point = PointCloud(np.array([tangent]), np.array([np.inf]), np.ones(1), np.zeros(1))
    modulus = np.abs(field_of([point], settings))
    rows, columns, slm = some_pixels(settings.panel, 20_000)
    seen = exact_phase(settings.bench, VirtualPoints.at(np.array(tangent)), slm, wavelength_m=515e-9)
    inside = np.linalg.norm(seen.pupil_m, axis=-1) <= settings.bench.pupil_diameter_m / 2
    light = modulus[rows, columns] ** 2
    assert light[~inside].sum() < 0.03 * light.sum()  # the edge is 0.2 mm soft: 1.5 %
    assert np.mean(light[inside] > 0.2) > 0.97
    wanted = transmission(seen.pupil_m, settings.bench.pupil_diameter_m)
    assert np.sqrt(np.mean((modulus[rows, columns] - wanted) ** 2)) < 0.03


def test_a_view_is_seen_through_its_part_of_the_pupil_only():
    part = Aperture((0.4e-3, -0.5e-3), 1.2e-3)
    scene = [cloud(SMALL, 12, aperture=part), cloud(SMALL, 9, seed=5, aperture=Aperture((-0.6e-3, 0.2e-3), 1.0e-3))]
    assert relative_error(scene, SMALL) < 0.12  # a small disc has more edge for its area


def test_points_at_many_depths_share_plans_within_the_accuracy():
    rng = np.random.default_rng(4)
    scene = cloud(SMALL, 60, distance=1 / rng.uniform(0.01, 1.0, 60))
    bins = depth_bins(scene, SMALL)
    assert 3 < len(bins) < 30
    assert sorted(np.concatenate([index for _, index in bins]).tolist()) == list(range(60))
    assert relative_error([scene], SMALL) < 0.1


def test_a_sphere_and_a_plane_are_one_depth_each():
    sphere = cloud(SMALL, 50, distance=0.3)
    plane = replace(sphere, distance_m=0.3 * np.sqrt(1 + np.sum(sphere.field_tan**2, axis=-1)))
    (first, _), *others = depth_bins(sphere, SMALL)
    assert not others
    assert first.inverse_m == pytest.approx(1 / 0.3)
    assert not first.flat
    ((second, _),) = depth_bins(plane, SMALL)
    assert second.flat
    assert second.inverse_m == pytest.approx(1 / 0.3)


def test_the_direct_hologram_is_the_direct_sum():
    settings = replace(SMALL, method=Direct())
    scene = [cloud(settings, 3), cloud(settings, 2, seed=3, distance=0.4)]
    assert relative_error(scene, settings) < 1e-3  # interpolated phases: 1e-4 rad


def test_the_direct_sum_is_the_sum_of_the_points_waves():
    scene = cloud(SMALL, 5)
    slm = some_pixels(SMALL.panel, 50)[2]
    total = np.zeros(50, complex)
    for tangent, amplitude, phase in zip(scene.field_tan, scene.amplitude, scene.phase_rad, strict=True):
        exact = exact_phase(SMALL.bench, VirtualPoints.at(tangent), slm, wavelength_m=515e-9)
        radius = np.linalg.norm(exact.pupil_m, axis=-1)
        edge = np.clip((radius - 1.5e-3) / 0.2e-3, -0.5, 0.5)
        total += amplitude * (0.5 - 0.5 * np.sin(np.pi * edge)) * np.exp(1j * (exact.phase_rad + phase))
    reference = np.exp(2j * np.pi * reference_turns(SMALL).at(slm))
    assert np.allclose(direct_sum(SMALL, [scene], slm) * reference, total, atol=1e-4)


def test_a_wavefront_correction_is_added_in_the_pupil():
    # 0.7 rad of oblique astigmatism at the centre, growing along x
    coefficients = ((0.7, 0.0, 0.5), (0.0, 0.0, 0.3))
    added = Wavefront((5, 7), coefficients, (0.11, 0.09), 1, 515e-9)
    settings = replace(SMALL, wavefront=added)
    scene = cloud(settings, 30)
    assert relative_error([scene], settings) < 0.1
    assert relative_error([scene], SMALL) < 0.1
    difference = field_of([scene], settings) - field_of([scene], SMALL)
    assert np.linalg.norm(difference) > 0.3 * np.linalg.norm(field_of([scene], SMALL))


def test_a_correction_at_another_colour_is_the_same_path():
    added = Wavefront((4,), ((1.0,),), (0.1, 0.1), 0, 515e-9)
    green, red = (
        added.phase(np.zeros((1, 2)), np.array([[1e-3, 0.0]]), pupil_diameter_m=3e-3, wavelength_m=w)
        for w in (515e-9, 639e-9)
    )
    assert green[0] * 515 == pytest.approx(red[0] * 639)


def test_sight_coordinates_go_there_and_back():
    for gaze in ((0.0, 0.0), (0.12, -0.1)):
        settings = replace(FULL, gaze_rad=gaze)
        seen = sight(settings)
        slm = np.random.default_rng(0).uniform(-1, 1, (200, 2)) * settings.panel.half_size_m
        s = sight_of(settings, slm)
        assert np.abs(seen.to_sight.at(slm) - s).max() < 3e-8  # a thousandth of the light's angular grain
        assert np.abs(seen.panel(s) - slm).max() < 1e-9


def test_the_pupil_is_the_spectrum_in_sight_coordinates():
    # u = d(phase) / ds of a point crosses the pupil at q(u): what makes the footprint a mask
    seen = sight(FULL)
    rng = np.random.default_rng(0)
    s = seen.to_sight.at(rng.uniform(-1, 1, (300, 2)) * FULL.panel.half_size_m)
    points = VirtualPoints.at(rng.uniform(-0.2, 0.2, (300, 2)))

    def phase(at):
        found = exact_phase(FULL.bench, points, seen.panel(at), wavelength_m=515e-9)
        return found.phase_rad - seen.reference_rad(at), found.pupil_m

    step = np.eye(2) * 1e-6
    u = np.stack([(phase(s + d)[0] - phase(s - d)[0]) / 2e-6 for d in step], axis=-1)
    pupil = phase(s)[1]
    inside = np.linalg.norm(pupil, axis=-1) < 1.7e-3
    error = np.linalg.norm(seen.pupil(u) - pupil, axis=-1)[inside]
    assert np.sqrt(np.mean(error**2)) < 0.006 * 1.5e-3


def test_points_in_a_convex_outline_are_found():
    outline = np.array([[-1.0, -0.5], [0.5, -1.0], [1.5, 0.2], [0.3, 1.0], [-0.8, 0.6]])
    points = np.random.default_rng(0).uniform(-2, 2, (2000, 2))
    following = np.roll(outline, -1, axis=0) - outline
    away = points[:, None] - outline
    inside = np.all(following[:, 0] * away[..., 1] - following[:, 1] * away[..., 0] >= 0, axis=1)
    assert np.array_equal(inside_outline(points, outline), inside)


def test_patches_that_show_no_lit_point_are_left_out_and_named():
    corner = replace(cloud(FULL, 4), field_tan=np.tan(12 * DEG) * np.array([[1.0, 1], [0.99, 1], [1, 0.99], [0.98, 1]]))
    coarse = replace(FULL, panel=Panel(960, 540, 4 * 3.74e-6))
    found = synthesise([corner], coarse, reach=(9, 9), clock=Clock.start())
    assert any("patches of the panel: show no lit point" in sentence for sentence in found.skipped)


def test_the_same_points_with_another_brightness_use_the_same_plans():
    scene = cloud(SMALL, 500)
    field_of([scene], SMALL)
    clock = Clock.start()
    again = replace(scene, amplitude=scene.amplitude[::-1].copy())
    synthesise([again], SMALL, reach=(9, 9), clock=clock)
    fresh = Clock.start()
    synthesise([cloud(SMALL, 500, seed=9)], SMALL, reach=(9, 9), clock=fresh)
    assert relative_error([again], SMALL) < 0.1
    assert clock.seconds["plans"] < fresh.seconds["plans"]


def test_the_direct_hologram_of_a_large_panel_is_interpolated_well():
    scene = cloud(FULL, 2)
    rows, columns, slm = some_pixels(COARSE.panel, 300)
    found = direct_hologram(COARSE, [scene])[rows, columns]
    assert np.abs(found - direct_sum(COARSE, [scene], slm)).max() < 2e-3


def test_a_depth_with_few_points_is_summed_point_by_point(monkeypatch):
    monkeypatch.undo()
    far, near = cloud(SMALL, 40), cloud(SMALL, 3, seed=8, distance=0.37)
    assert relative_error([far, near], SMALL) < 0.1
    assert relative_error([near], SMALL) < 1e-3  # only traced: no patch, no mask
    clock = Clock.start()
    synthesise([near], SMALL, reach=(9, 9), clock=clock)
    assert "plans" not in clock.seconds


def test_points_that_light_nothing_of_the_panel_are_no_hologram(monkeypatch):
    monkeypatch.undo()
    aside = replace(cloud(SMALL, 2), field_tan=np.array([[0.5, 0.4], [0.5, -0.4]]))
    for settings in (SMALL, replace(SMALL, method=Direct())):
        assert synthesise([aside], settings, reach=(9, 9), clock=Clock.start()) is None


def test_a_point_whose_phase_is_not_smooth_over_the_panel_is_refused(monkeypatch):
    monkeypatch.setattr(direct, "_TAIL_RAD", 1e-13)  # as if rounding were a wiggle
    with pytest.raises(SamplingError, match="not smooth over the panel"):
        direct_hologram(SMALL, [cloud(SMALL, 1, distance=2.0)])
