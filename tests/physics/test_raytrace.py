"""The ray trace against what an ellipsoid must do, and against itself run backwards."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import ConfigError
from holocal.optics.bench import Bench, Panel, Pose, field_directions, image_tangents
from holocal.optics.raytrace import connect, trace_to_pupil, trace_to_slm

MISALIGNED = Bench(
    mirror=Pose((0.01, 0.005, -0.01), (3e-4, -2e-4, 4e-4)), slm=Pose((0.01, -0.01, 0.02), (5e-4, 2e-4, -3e-4))
)


def test_nominal_bench_has_the_thesis_numbers():
    bench = Bench()
    # physics.md 2: SLM centre (171.75, 0, -52.48) mm, arms 50 and 200 mm, 59.18 degrees apart, M = 4
    np.testing.assert_allclose(bench.slm_centre * 1e3, [171.75, 0.0, -52.48], atol=0.005)
    to_slm = bench.slm_centre - bench.mirror_point
    assert np.linalg.norm(to_slm) == pytest.approx(0.2, abs=1e-12)
    assert np.degrees(np.arccos(-to_slm[2] / 0.2)) == pytest.approx(59.18, abs=0.005)
    assert bench.magnification == pytest.approx(4.0)


def test_every_ray_through_one_focus_meets_the_other_after_the_major_axis():
    bench = Bench()
    direction = field_directions(np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2)))
    rays = trace_to_slm(bench, np.zeros(3), direction)
    # the two foci of an ellipsoid: total path 2 a, whatever the direction
    np.testing.assert_allclose(rays.landing_m, 0, atol=1e-14)
    np.testing.assert_allclose(rays.to_mirror_m + rays.from_mirror_m, 0.25, atol=1e-14)


def test_reflection_at_the_mirror_keeps_the_angle_to_the_normal():
    bench = MISALIGNED
    origin = bench.pupil_points(np.array([[1e-3, -0.5e-3], [0.2e-3, 1.1e-3]]))
    direction = field_directions(np.array([[0.1, -0.05], [-0.15, 0.12]]))
    rays = trace_to_slm(bench, origin, direction)
    mirror = origin + rays.to_mirror_m[:, None] * direction
    offset = mirror - bench.mirror_centre
    assert np.einsum("ij,jk,ik->i", offset, bench.mirror_quadric, offset) == pytest.approx(1.0, abs=1e-12)
    normal = offset @ bench.mirror_quadric
    outgoing = rays.direction @ bench.slm_axes.T
    np.testing.assert_allclose(np.sum(normal * direction, -1), -np.sum(normal * outgoing, -1), rtol=1e-12)


@settings(max_examples=30, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-0.03, 0.03)] * 6),
    shift=st.tuples(*[st.floats(-1e-3, 1e-3)] * 6),
    seed=st.integers(0, 2**31),
)
def test_the_light_goes_back_the_way_it_was_traced(turn, shift, seed):
    bench = Bench(mirror=Pose(turn[:3], shift[:3]), slm=Pose(turn[3:], shift[3:]))
    rng = np.random.default_rng(seed)
    pupil, tangents = rng.uniform(-1e-3, 1e-3, (20, 2)), rng.uniform(-0.2, 0.2, (20, 2))
    there = trace_to_slm(bench, bench.pupil_points(pupil), field_directions(tangents))
    back = trace_to_pupil(bench, there.landing_m, -there.direction)
    np.testing.assert_allclose(back.landing_m, pupil, atol=1e-13)
    np.testing.assert_allclose(back.to_mirror_m, there.from_mirror_m, atol=1e-13)
    np.testing.assert_allclose(-back.direction, field_directions(tangents), atol=1e-12)


def test_connect_finds_the_ray_between_two_points_and_its_path_is_stationary():
    rng = np.random.default_rng(1)
    slm, pupil = rng.uniform(-1, 1, (300, 2)) * [7e-3, 4e-3], rng.uniform(-1, 1, (300, 2)) * 1.5e-3
    found = connect(MISALIGNED, slm, pupil)
    assert found.error_m.max() < 1e-12
    # Fermat: moving the panel point by d changes the path by -direction . d, to first order
    step = 1e-7
    moved = connect(MISALIGNED, slm + np.array([step, 0.0]), pupil).path_m
    behind = connect(MISALIGNED, slm - np.array([step, 0.0]), pupil).path_m
    np.testing.assert_allclose((moved - behind) / (2 * step), -found.slm_direction[:, 0], atol=1e-8)


def test_positive_field_angles_use_the_positive_side_of_the_panel():
    # the frames of docs/physics.md: +x field is imaged to +x_S, +y field to +y_S
    rays = trace_to_slm(
        Bench(), Bench().pupil_points(np.zeros((2, 2))), field_directions(np.array([[0.1, 0.0], [0.0, 0.1]]))
    )
    assert rays.landing_m[0, 0] > 3e-3
    assert rays.landing_m[1, 1] > 3e-3


def test_a_ray_that_misses_is_said_to_be_invalid():
    origin = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])  # the first starts outside of the ellipsoid
    rays = trace_to_slm(Bench(), origin, field_directions(np.array([[0.0, 0.0], [0.1, 0.0]])))
    assert list(rays.valid) == [False, True]


def test_pixels_ascend_in_x_and_descend_in_y():
    panel = Panel(5, 4, 2e-6)
    np.testing.assert_allclose(panel.x_m, [-4e-6, -2e-6, 0, 2e-6, 4e-6])
    np.testing.assert_allclose(panel.y_m, [3e-6, 1e-6, -1e-6, -3e-6])
    x, y = image_tangents(3, 2, (2 * np.arctan(0.3), 2 * np.arctan(0.2)))
    np.testing.assert_allclose(x, [-0.2, 0.0, 0.2])
    np.testing.assert_allclose(y, [0.1, -0.1])


def test_an_impossible_ellipsoid_is_refused_with_its_numbers():
    with pytest.raises(ConfigError, match="50 and 60 mm"):
        Bench(semi_major_m=0.05, semi_minor_m=0.06)
    with pytest.raises(ConfigError, match=r"between 35\.21 and 214\.79 mm"):
        Bench(eye_to_mirror_m=0.01)
