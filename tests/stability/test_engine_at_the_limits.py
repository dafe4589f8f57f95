"""The engine end to end on small panels, at the ends of every range: as good as the accuracy asked for, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_points import cloud

from holocal.errors import HolocalError, InputError, SamplingError, UsageError
from holocal.hologram import warped
from holocal.hologram.clock import Clock
from holocal.hologram.direct import direct_sum
from holocal.hologram.pipeline import HologramSettings, render
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import Warped, Zones
from holocal.hologram.synthesis import synthesise
from holocal.hologram.wavefront import Wavefront
from holocal.optics.bench import Bench, Panel, Pose

DEG = np.pi / 180
BASE = HologramSettings(Panel(64, 48, 3.74e-6), Bench(), 515e-9, (12 * DEG, 10 * DEG))


def error_of(scene, settings, pixels=300):
    """Return the relative error against the direct sum at random pixels."""
    panel = settings.panel
    slm = np.stack(np.meshgrid(panel.x_m, panel.y_m), axis=-1).reshape(-1, 2)
    chosen = np.random.default_rng(1).permutation(len(slm))[:pixels]
    found = synthesise([scene], settings, reach=(10**6, 10**6), clock=Clock.start())
    exact = direct_sum(settings, [scene], slm[chosen])
    field = np.zeros(len(chosen)) if found is None else found.field.numpy().ravel()[chosen]
    assert np.all(np.isfinite(field))
    return np.linalg.norm(field - exact) / np.linalg.norm(exact)


def assert_a_frame(rendered, settings):
    shape = (settings.panel.height, settings.panel.width)
    assert rendered.levels.shape == rendered.phase_rad.shape == shape
    assert np.all((rendered.phase_rad >= 0) & (rendered.phase_rad < np.float32(2 * np.pi)))
    assert 0 <= rendered.efficiency <= 1 + 1e-6
    assert np.all(np.isfinite(rendered.signal_error))


SIZES = [(64, 48), (97, 61), (1, 1), (1, 64), (64, 1), (1, 3), (2, 2), (2, 3), (1, 97), (601, 1), (3, 509), (480, 270)]


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_panels_of_any_size_are_right(size):
    chosen = replace(BASE, panel=Panel(*size, 3.74e-6))
    scene = cloud(chosen, 20)
    # half of the accuracy of 0.1: patches are small and the transforms are accurate to 0.004
    assert error_of(scene, chosen) < 0.05
    assert_a_frame(render([scene], chosen), chosen)


@pytest.mark.parametrize("accuracy", [0.03, 0.3, 3.0])
@pytest.mark.parametrize(
    ("wavelength", "size"),
    [
        (200e-9, (97, 61)),
        (200e-9, (1, 1)),
        (473e-9, (97, 61)),
        (1.55e-6, (97, 61)),
        (10e-6, (97, 61)),
        (10e-6, (1, 64)),
    ],
)
def test_wavelengths_from_200_nm_to_10_um_are_right(wavelength, size, accuracy):
    chosen = replace(BASE, panel=Panel(*size, 3.74e-6), wavelength_m=wavelength, method=Warped(accuracy))
    # at 10 um the pupil's edge, 0.2 mm soft, is as wide as its own Fresnel fringe, sqrt(wavelength r / 2) = 0.24 mm:
    # the mask, which undoes that diffraction to first order, leaves 0.03 to 0.06 of the field whatever is asked for
    assert error_of(cloud(chosen, 30), chosen) < max(accuracy, 0.08 * wavelength / 10e-6)


@pytest.mark.parametrize("distance", [1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.1, 1.0, 1e4, 1e9, np.inf])
def test_points_from_1_um_to_infinity_are_right(distance):
    scene = cloud(BASE, 20, distance=distance)
    assert error_of(scene, BASE) < 0.02
    assert_a_frame(render([scene], BASE), BASE)


def test_ten_kilometres_and_infinity_are_nearly_the_same_hologram():
    fields = [
        synthesise([cloud(BASE, 20, distance=d)], BASE, reach=(9, 9), clock=Clock.start()).field.numpy()
        for d in (1e4, 1e7, np.inf)
    ]
    # k R^2 / 2 D is 1.4e-3 rad at the rim from 10 km; the pistons are equal because |p| - R is
    assert np.linalg.norm(fields[0] - fields[2]) < 2e-3 * np.linalg.norm(fields[2])
    assert np.linalg.norm(fields[1] - fields[2]) < 1e-4 * np.linalg.norm(fields[2])  # float32 sums


def test_points_at_all_depths_at_once_are_right():
    scene = replace(cloud(BASE, 9), distance_m=np.array([1e-6, 1e-4, 1e-2, 0.1, 0.3, 1.0, 100.0, 1e4, np.inf]))
    assert error_of(scene, BASE) < 0.05  # 9 holograms' errors


@pytest.mark.parametrize("distance", [1e-7, 1e-20, 1e-300, 5e-324])
def test_points_nearer_than_a_micrometre_are_refused(distance):
    with pytest.raises(InputError, match=r"distance is .* the limit is 1e-06 m"):
        render([cloud(BASE, 3, distance=distance)], BASE)
    with pytest.raises(UsageError, match="depth_m"):
        replace(BASE, depth_m=distance)


def test_points_whose_wavefront_the_patches_cannot_follow_are_refused():
    # a centimetre from the pupil, on a panel of full size: 0.2 rad where 0.1 was asked for
    full = replace(BASE, panel=Panel(480, 270, 8 * 3.74e-6), fov_rad=(25 * DEG, 25 * DEG))
    near = cloud(full, 9, distance=5e-3)  # five would be summed one by one
    with pytest.raises(SamplingError, match=r"Points 0\.005 m from the pupil .* not 0\.1") as caught:
        synthesise([near], full, reach=(9, 9), clock=Clock.start())
    assert caught.value.measured > caught.value.limit == 0.1


@pytest.mark.parametrize("gaze", [(0.3, 0.2), (1.04, 0.0), (0.0, 1.04), (-1.04, 1.04), (-1.04, -1.04)])
def test_gazes_up_to_60_degrees_are_right(gaze):
    assert error_of(cloud(BASE, 20), replace(BASE, gaze_rad=gaze)) < 0.03


@pytest.mark.parametrize("degrees", [0.1, 1.0, 25.0, 60.0])
def test_fields_from_a_tenth_of_a_degree_to_60_are_right(degrees):
    chosen = replace(BASE, fov_rad=(degrees * DEG, 0.9 * degrees * DEG))
    assert error_of(cloud(chosen, 200), chosen) < 0.03


def test_in_a_field_of_100_degrees_the_points_on_the_panel_are_right():
    chosen = replace(BASE, fov_rad=(100 * DEG, 100 * DEG))
    scene = cloud(chosen, 50)
    scene.field_tan[:5] *= 0.05
    assert error_of(scene, chosen) < 0.03


@pytest.mark.parametrize("tangent", [(0.2, 0.2), (1.0, 1.0), (-5.67, 0.0), (0.0, 100.0), (1e6, 1e6)])
def test_one_point_beside_the_panel_is_a_uniform_frame(tangent):
    point = PointCloud(np.array([tangent]), np.array([np.inf]), np.ones(1), np.zeros(1))
    rendered = render([point], BASE)
    assert not rendered.levels.any()
    assert rendered.efficiency == 0
    assert any("uniform" in sentence for sentence in rendered.skipped)


def test_ten_points_at_one_place_are_one_point_ten_times_as_bright():
    one = PointCloud(np.array([[0.01, 0.02]]), np.array([0.5]), np.ones(1), np.ones(1))
    ten = PointCloud(np.tile(one.field_tan, (10, 1)), np.full(10, 0.5), np.ones(10), np.ones(10))
    assert error_of(ten, BASE) < 0.01
    fields = [synthesise([s], BASE, reach=(9, 9), clock=Clock.start()).field.numpy() for s in (one, ten)]
    assert np.linalg.norm(fields[1] - 10 * fields[0]) < 1e-2 * np.linalg.norm(fields[1])  # transforms: 0.004


def test_points_that_cancel_leave_nothing_but_rounding():
    two = PointCloud(np.full((2, 2), 0.01), np.full(2, np.inf), np.ones(2), np.array([0.0, np.pi]))
    found = synthesise([two], BASE, reach=(9, 9), clock=Clock.start()).field.numpy()
    assert np.abs(found).max() < 1e-5
    assert_a_frame(render([two], BASE), BASE)


@pytest.mark.parametrize(
    "bench",
    [
        Bench(mirror=Pose((10 * DEG, 0.0, 0.0))),
        Bench(mirror=Pose((0.0, -30 * DEG, 0.0))),
        Bench(mirror=Pose((180 * DEG, 0.0, 0.0))),
        Bench(slm=Pose((0.0, 90 * DEG, 0.0))),
        Bench(slm=Pose(shift_m=(0.2, 0.0, 0.0))),
        Bench(slm=Pose(shift_m=(0.0, 0.0, 10.0))),
        Bench(slm=Pose(shift_m=(0.0, 0.0, -10.0))),
        Bench(mirror=Pose(shift_m=(0.01, 0.0, 0.0))),
        Bench(eye_relief_m=1e-9),
        Bench(pupil_diameter_m=0.1),
    ],
    ids=["10", "30", "180", "edge on", "aside", "past the mirror", "behind", "mirror aside", "no relief", "huge pupil"],
)
def test_benches_from_which_nothing_lands_are_refused_at_once(bench):
    with pytest.raises((InputError, SamplingError)) as caught:
        render([cloud(BASE, 5)], replace(BASE, bench=bench))
    assert caught.value.fix


@pytest.mark.parametrize("bench", [Bench(mirror=Pose((3 * DEG, 0.0, 0.0))), Bench(mirror=Pose((9 * DEG, 0.0, 0.0)))])
def test_a_mirror_turned_so_far_that_the_field_misses_the_panel_is_a_uniform_frame(bench):
    rendered = render([cloud(BASE, 20)], replace(BASE, bench=bench))
    assert not rendered.levels.any()


@pytest.mark.parametrize("distance", [1e-6, 1e-3])
def test_near_points_on_a_bench_turned_by_9_degrees_are_right(distance):
    chosen = replace(BASE, bench=Bench(mirror=Pose((9 * DEG, 0.0, 0.0))))
    assert error_of(cloud(chosen, 20, distance=distance), chosen) < 0.03  # 0.01 of it are the transforms'


@pytest.mark.parametrize(
    "wide", [{"wavelength_m": 200e-9}, {"panel": Panel(32, 32, 20e-6)}, {"gaze_rad": (1.04, 0.0)}], ids=str
)
@pytest.mark.parametrize("method", [Warped(), Zones(2)], ids=["patches", "zones"])
def test_a_pupil_wider_than_the_panels_band_is_refused(wide, method):
    with pytest.raises(SamplingError, match="times as wide as the panel's band") as caught:
        render([cloud(BASE, 5)], replace(BASE, method=method, **wide))
    assert caught.value.measured > caught.value.limit


def correction(rad, nolls=(5,), **more):
    rows = tuple((rad, 0.0, 0.5 * rad) for _ in nolls)
    return Wavefront(
        **({"noll": nolls, "coefficients_rad": rows, "half_tan": (0.1, 0.1), "degree": 1} | more), wavelength_m=515e-9
    )


@pytest.mark.parametrize("nolls", [(2, 3), (4,), (5, 7, 12), (11,), (861,)], ids=str)
@pytest.mark.parametrize("rad", [1e-300, 1e-3, 1.0, 10.0, 1e3])
def test_wavefront_corrections_up_to_1000_rad_are_right_or_refused(rad, nolls):
    chosen = replace(BASE, wavefront=correction(rad, nolls))
    try:
        error = error_of(cloud(chosen, 20), chosen)
    except SamplingError as refused:
        assert refused.measured > refused.limit
        assert "wavefront correction" in str(refused)
        assert rad >= 1.0
        return
    assert error < 0.1
    assert rad < 1e3


def test_a_correction_of_1000_rad_on_the_whole_panel_is_refused_without_trying_every_cut(monkeypatch):
    tried = []
    original = warped.warped_plan
    monkeypatch.setattr(warped, "warped_plan", lambda *a: tried.append(a[2]) or original(*a))
    full = replace(BASE, panel=Panel(3840, 2160, 3.74e-6), fov_rad=(25 * DEG, 25 * DEG), wavefront=correction(1e3))
    with pytest.raises(SamplingError, match="finest patches"):
        warped.accurate_plan(full)
    assert len(tried) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"coefficients_rad": ((np.nan, 0.0, 0.0),)},
        {"coefficients_rad": ((np.inf, 0.0, 0.0),)},
        {"coefficients_rad": ((1.0,),)},
        {"noll": (0,)},
        {"half_tan": (0.0, 0.1)},
        {"half_tan": (np.nan, 0.1)},
        {"degree": -1, "coefficients_rad": ((),)},
    ],
    ids=str,
)
def test_corrections_without_a_meaning_are_refused(wrong):
    with pytest.raises(InputError):
        correction(1.0, **wrong)


@given(
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    wavelength=st.floats(200e-9, 3e-6),
    exponent=st.floats(-6, 5),
    gaze=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)),
    field=st.floats(0.1, 60),
    turn=st.tuples(*[st.floats(-0.03, 0.03)] * 3),
    accuracy=st.floats(0.05, 3),
)
@settings(deadline=None, max_examples=15, derandomize=True)
def test_whatever_is_asked_for_is_right_or_refused_with_a_sentence(
    width, height, wavelength, exponent, gaze, field, turn, accuracy
):
    chosen = HologramSettings(
        Panel(width, height, 3.74e-6),
        Bench(mirror=Pose(turn)),
        wavelength,
        (field * DEG, field * DEG),
        gaze,
        method=Warped(accuracy),
    )
    scene = cloud(chosen, 12, distance=10.0**exponent)
    slm = np.stack(np.meshgrid(chosen.panel.x_m, chosen.panel.y_m), axis=-1).reshape(-1, 2)
    try:
        found = synthesise([scene], chosen, reach=(9, 9), clock=Clock.start())
        exact = direct_sum(chosen, [scene], slm).reshape(height, width)
    except HolocalError as refused:
        assert refused.what
        return
    field_there = np.zeros((height, width)) if found is None else found.field.numpy()
    assert np.all(np.isfinite(field_there))
    # points whose soft rim alone is on the panel: an absolute floor of 0.05 of a point's field
    assert np.linalg.norm(field_there - exact) < accuracy * np.linalg.norm(exact) + 0.05 * np.sqrt(width * height)
