"""Rays and phases from 1 um to infinity, behind the eye, past the mirror, past the panel: right, or said to be none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import ConfigError, InputError
from holocal.hologram import phase_model
from holocal.hologram.depths import depth_bins
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import HologramSettings
from holocal.optics.bench import Bench, Panel, Pose, field_directions
from holocal.optics.phase_function import VirtualPoints, exact_phase, path_lead, pupil_grid, trace_points, traced_phase
from holocal.optics.raytrace import connect, newton_step, trace_to_pupil, trace_to_slm

DEG = np.pi / 180
WAVELENGTH = 515e-9
DISTANCES = [1e-6, 1e-5, 1e-4, 1e-3, 5e-3, 0.01, 0.1, 1.0, 1e2, 1e4, 1e9, 1e300, np.inf]
SETTINGS = HologramSettings(Panel(64, 48, 3.74e-6), Bench(), WAVELENGTH, (12 * DEG, 10 * DEG))
TURNED = Bench(mirror=Pose((9 * DEG, 0.0, 0.0)))  # the panel's image is 18 degrees beside the gaze


def panel_points(half=(7e-3, 4e-3), count=5):
    return np.stack(np.meshgrid(*(np.linspace(-h, h, count) for h in half)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("bench", [Bench(), TURNED], ids=["nominal", "turned by 9 degrees"])
def test_every_ray_through_the_pupil_is_found_at_every_distance(bench, distance):
    tangents = np.tan(np.array([[0.0, 0.0], [10.0, -6.0], [-9.0, 7.0]]) * DEG)
    found = exact_phase(bench, VirtualPoints.at(tangents[:, None], distance), panel_points(), wavelength_m=WAVELENGTH)
    assert np.all(np.isfinite(found.phase_rad))
    assert np.all(np.isfinite(found.pupil_m))
    seen = np.linalg.norm(found.pupil_m, axis=-1) < 1.5e-3
    assert np.all(found.error_m[seen] < 1e-9)  # 4e-4 rad; on the nominal bench 1e-12 m
    assert distance > 1e-3 or seen.any()  # the light of a point in the pupil goes everywhere


@pytest.mark.parametrize("distance", DISTANCES)
def test_the_phase_found_is_the_phase_traced_at_every_distance(distance):
    # forward: points of the pupil, through the virtual point, to the panel. Near points: only a neighbourhood of their
    # own foot reaches the mirror within sight, so the pupil points scale with the distance.
    tangents = np.array([[0.05, -0.08], [-0.11, 0.03]])[:, None]
    points = VirtualPoints.at(tangents, distance)
    pupil = pupil_grid(3e-3, 7) * min(1.0, distance / 0.03)
    if distance < 0.03:
        pupil = pupil + distance * tangents  # straight through the point, more or less
    rays = trace_points(Bench(), points, pupil)
    found = exact_phase(Bench(), points, rays.landing_m, wavelength_m=WAVELENGTH)
    wanted = traced_phase(points, pupil, rays, wavelength_m=WAVELENGTH)
    # k 250 mm is 3e6 rad: 1e-16 of it, times a few, is 1e-9; and the slope of 4e5 rad / m times 1e-12 m is less
    assert np.abs(found.phase_rad - wanted)[rays.valid].max() < 1e-7
    assert rays.valid.any()


def test_a_point_at_ten_kilometres_differs_from_infinity_by_the_quadratic_term():
    slm = panel_points((1e-3, 1e-3))
    tangent = np.array([0.03, 0.02])
    far, endless = (
        exact_phase(Bench(), VirtualPoints.at(tangent, d), slm, wavelength_m=WAVELENGTH) for d in (1e4, np.inf)
    )
    q = endless.pupil_m
    direction = VirtualPoints.at(tangent).direction
    square = np.sum(q * q, axis=-1) - (q @ direction[:2]) ** 2
    wanted = 2 * np.pi / WAVELENGTH * square / (2 * 1e4)
    # 1e-3 rad in all; the rays' own move is second order, float64 leaves 1e-8
    assert np.abs(far.phase_rad - endless.phase_rad - wanted).max() < 1e-7


@given(
    st.floats(-6, 12),
    st.tuples(st.floats(-6, 6), st.floats(-6, 6)),
    st.tuples(st.floats(-3e-3, 3e-3), st.floats(-3e-3, 3e-3)),
)
@settings(deadline=None, max_examples=100, derandomize=True)
def test_the_path_lead_agrees_with_long_double_at_every_distance_and_angle(exponent, tangent, q):
    # tangents to 6: 83 degrees
    distance = 10.0**exponent
    points = VirtualPoints.at(np.array(tangent), distance)
    long = [np.longdouble(v) for v in (*tangent, 1.0)]
    norm = np.sqrt(sum(v * v for v in long))
    p = [np.longdouble(distance) * v / norm for v in long]
    away = np.sqrt((p[0] - np.longdouble(q[0])) ** 2 + (p[1] - np.longdouble(q[1])) ** 2 + p[2] ** 2)
    # the same in a form that loses nothing in 64 bits either
    dot, square = p[0] * q[0] + p[1] * q[1], np.longdouble(q[0]) ** 2 + np.longdouble(q[1]) ** 2
    exact = float((2 * dot - square) / (np.longdouble(distance) + away))
    # 1e-18 m is 1e-11 rad; where p is close to q the digits of 1 - 2 a + b are lost in the root, not in what counts
    assert abs(float(path_lead(points, np.array(q))) - exact) < 1e-15 * np.hypot(*q) + 4e-8 * min(distance, 1e-6)


@pytest.mark.parametrize("distance", [0.0, -0.0, -1.0, -1e-300, -np.inf, np.nan])
def test_points_at_or_behind_the_eye_are_refused(distance):
    with pytest.raises(InputError):
        VirtualPoints.at(np.zeros(2), distance)
    with pytest.raises(InputError):
        PointCloud(np.zeros((1, 2)), np.array([distance]), np.ones(1), np.zeros(1))


@pytest.mark.parametrize("tangent", [np.nan, np.inf, 1e7, -1e300])
def test_directions_at_a_right_angle_to_the_gaze_are_refused(tangent):
    with pytest.raises(InputError, match="tangents within"):
        VirtualPoints.at(np.array([0.0, tangent]))


@pytest.mark.parametrize(
    "tangent", [5.67, -5.67, 100.0, 1e6], ids=["80 deg", "-80 deg", "89.4 deg", "90 deg less 0.2 s"]
)
@pytest.mark.parametrize("distance", [1e-6, 0.1, np.inf])
def test_far_off_directions_find_no_ray_through_the_pupil_or_a_true_one(tangent, distance):
    point = VirtualPoints.at(np.array([tangent, 0.0]), distance)
    found = exact_phase(Bench(), point, panel_points(), wavelength_m=WAVELENGTH)
    assert np.all(np.isfinite(found.phase_rad))
    assert np.all(np.isfinite(found.pupil_m))
    through = np.linalg.norm(found.pupil_m, axis=-1) < 1.5e-3
    assert np.all(found.error_m[through] < 1e-9)
    if distance > 0.01:
        assert not through.any()


def test_rays_that_miss_say_so_and_carry_no_nan():
    outside = np.array([[0.0, 0.0, 0.5], [0.0, 0.3, 0.0], [10.0, 0.0, 0.0], [0.0, 0.0, -1e6]])
    for direction in np.eye(3):
        rays = trace_to_slm(Bench(), outside, np.broadcast_to(direction, outside.shape))
        assert not rays.valid.any()
        for values in (rays.landing_m, rays.to_mirror_m, rays.from_mirror_m, rays.direction):
            assert np.all(np.isfinite(values))


def test_a_ray_along_the_panel_is_no_landing():
    # backwards: leaving the panel within its own plane, and away from the mirror
    along = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rays = trace_to_pupil(Bench(), np.zeros((2, 2)), along)
    assert np.all(np.isfinite(rays.landing_m[rays.valid]))
    flat = Bench(slm=Pose((0.0, 90 * DEG, 0.0)))  # the panel seen edge on: the axial ray never meets its plane ahead
    seen = trace_to_slm(flat, np.zeros((1, 3)), field_directions(np.zeros((1, 2))))
    assert np.all(np.isfinite(seen.landing_m))


@pytest.mark.parametrize(
    "bench",
    [
        Bench(mirror=Pose((30 * DEG, 0.0, 0.0))),
        Bench(mirror=Pose((0.0, -30 * DEG, 0.0))),
        Bench(mirror=Pose((180 * DEG, 0.0, 0.0))),
        Bench(slm=Pose((0.0, 90 * DEG, 0.0))),
        Bench(slm=Pose(shift_m=(0.2, 0.0, 0.0))),
        Bench(slm=Pose(shift_m=(0.0, 0.0, 10.0))),
        Bench(mirror=Pose(shift_m=(10.0, 0.0, 0.0))),
        Bench(mirror=Pose(shift_m=(0.0, 0.0, -1e6))),
    ],
    ids=["30 up", "30 aside", "turned round", "edge on", "20 cm aside", "past the mirror", "10 m away", "1000 km"],
)
def test_where_no_light_can_come_the_search_ends_and_says_so(bench):
    found = connect(bench, panel_points(), np.zeros(2))
    assert not np.any(np.isnan(found.error_m))
    assert np.any(found.error_m > 1e-9)
    traced = exact_phase(bench, VirtualPoints.at(np.zeros(2)), panel_points(), wavelength_m=WAVELENGTH)
    assert not np.any(np.isnan(traced.error_m))


def test_rays_through_the_pupil_that_are_not_found_are_refused(monkeypatch):
    monkeypatch.setattr(phase_model, "_LOST_M", -1.0)  # no bench was found where the search fails inside the pupil
    with pytest.raises(InputError, match="rays through the pupil were not found"):
        phase_model.wanted_phase(SETTINGS, VirtualPoints.at(np.zeros(2)), np.zeros((1, 2)))


@pytest.mark.parametrize(
    "slope",
    [np.zeros((2, 2)), np.ones((2, 2)), np.full((2, 2), np.nan), np.full((2, 2), 1e-200), np.diag([np.inf, np.inf])],
)
def test_a_singular_slope_stops_a_search_instead_of_the_program(slope):
    both = np.stack([slope, np.diag([2.0, -4.0])])
    assert newton_step(both, np.ones((2, 2))).tolist() == [[0.0, 0.0], [0.5, -0.25]]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Bench(eye_relief_m=0.0),
        lambda: Bench(eye_relief_m=-0.012),
        lambda: Bench(eye_relief_m=0.05),
        lambda: Bench(eye_relief_m=np.nan),
        lambda: Bench(pupil_diameter_m=0.0),
        lambda: Bench(pupil_diameter_m=np.inf),
        lambda: Bench(pupil_diameter_m=np.nan),
        lambda: Bench(semi_major_m=np.nan),
        lambda: Pose((np.nan, 0.0, 0.0)),
        lambda: Pose(shift_m=(0.0, np.inf, 0.0)),
        lambda: Panel(0, 4, 1e-6),
        lambda: Panel(4, -1, 1e-6),
        lambda: Panel(4, 4, 0.0),
        lambda: Panel(4, 4, np.nan),
    ],
)
def test_benches_and_panels_that_cannot_be_are_refused(wrong):
    with pytest.raises(ConfigError):
        wrong()


@given(st.lists(st.floats(-6, 4), min_size=1, max_size=60), st.booleans())
@settings(deadline=None, max_examples=60, derandomize=True)
def test_every_point_is_in_one_depth_that_is_as_near_to_it_as_the_accuracy_asks(exponents, endless):
    distance = 10.0 ** np.array(exponents)
    if endless:
        distance[0] = np.inf
    scene = PointCloud(np.zeros((len(distance), 2)), distance, np.ones(len(distance)), np.zeros(len(distance)))
    bins = depth_bins(scene, SETTINGS)
    assert sorted(np.concatenate([index for _, index in bins]).tolist()) == list(range(len(distance)))
    # 0.4 of the accuracy of 0.1 rad, for a pupil of 3 mm: 0.035 dioptres from end to end
    for depth, index in bins:
        assert np.abs(1 / distance[index] - depth.inverse_m).max() <= 0.018 + 1e-9 * depth.inverse_m
