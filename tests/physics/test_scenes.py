"""Points, layers and light fields: each pixel becomes the point that it stands for, and only what is seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import InputError
from holocal.hologram.scenes.cloud import table_points
from holocal.hologram.scenes.image import QuadraticPhase, RandomPhase, ZeroPhase
from holocal.hologram.scenes.layers import depth_image_points, layer_points
from holocal.hologram.scenes.light_field import light_field_points
from holocal.optics.bench import image_tangents
from holocal.records.scene_data import DepthImage, Layer, Layers, LightField, ScatteredPoints, View

FOV = (0.5, 0.3)
RANDOM = RandomPhase(5)


def places(cloud):
    """The points' places (n, 3) in P, from their tangents and distances."""
    directions = np.column_stack([cloud.field_tan, np.ones(len(cloud))])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * cloud.distance_m[:, None]


def picture(cloud, shape):
    """The intensities (rows, columns) of a cloud on the grid of an image."""
    x_tan, y_tan = image_tangents(shape[1], shape[0], FOV)
    image = np.zeros(shape)
    column = np.abs(cloud.field_tan[:, :1] - x_tan).argmin(axis=1)
    row = np.abs(cloud.field_tan[:, 1:] - y_tan).argmin(axis=1)
    image[row, column] = cloud.amplitude**2
    return image


# -- initial phases ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", [RANDOM, RandomPhase(5, 2), ZeroPhase(), QuadraticPhase(515e-9, FOV, 3e-3)])
def test_points_in_a_grids_order_have_the_grids_phases(phase):
    x_tan, y_tan = image_tangents(7, 4, FOV)
    field_tan = np.stack(np.meshgrid(x_tan, y_tan), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(phase.at(field_tan), phase(x_tan, y_tan).ravel(), rtol=1e-12)


def test_random_phases_of_another_layer_or_seed_are_unrelated_and_of_layer_0_the_same():
    grid = image_tangents(60, 50, FOV)
    first = RANDOM(*grid)
    np.testing.assert_array_equal(RANDOM.of_layer(0)(*grid), first)
    for other in (RANDOM.of_layer(1), RANDOM.of_layer(2), RandomPhase(6), RANDOM.of_layer(1).of_layer(1)):
        # 3000 unit vectors: their mean has a length of about 0.018
        assert abs(np.exp(1j * (other(*grid) - first)).mean()) < 0.08
    assert ZeroPhase().of_layer(3) == ZeroPhase()


@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.2, 0.05), (-0.1, 0.12), (0.05, -0.14)])
def test_light_of_a_quadratic_phase_crosses_the_pupil_where_its_direction_says(centre):
    wavelength, diameter, share = 515e-9, 3e-3, 0.7
    phase = QuadraticPhase(wavelength, FOV, diameter, share)
    # a soft patch of the field, 2 mrad wide, its points closer than wavelength / pupil
    step = np.linspace(-4e-3, 4e-3, 81)
    x_tan, y_tan = centre[0] + step, centre[1] - step
    weight = np.exp(-((step[:, None] ** 2 + step**2) / 2e-3**2))
    light = weight * np.exp(1j * phase(x_tan, y_tan))
    t = np.stack(np.meshgrid(x_tan, y_tan), axis=-1)
    sines = t / np.sqrt(1 + np.sum(t**2, axis=-1, keepdims=True))
    q = np.linspace(-1.5e-3, 1.5e-3, 61)
    # U(q) = sum_s a(s) exp(-i k q . s), the inverse of E(s) = sum_q U(q) exp(i k q . s); both axes near separable
    k = 2 * np.pi / wavelength
    pupil = np.array(
        [[np.sum(light * np.exp(-1j * k * (qx * sines[..., 0] + qy * sines[..., 1]))) for qx in q] for qy in q]
    )
    power = np.abs(pupil) ** 2
    found = np.array([power.sum(axis=0) @ q, power.sum(axis=1) @ q]) / power.sum()
    corner = np.tan(np.array(FOV) / 2)
    corner_sine = np.linalg.norm(corner) / np.sqrt(1 + corner @ corner)
    middle = np.array(centre) / np.sqrt(1 + np.sum(np.square(centre)))
    np.testing.assert_allclose(found, share * diameter / 2 * middle / corner_sine, atol=2e-5)


# -- points -----------------------------------------------------------------------------------------------------------


def test_a_table_becomes_points_at_the_tangents_of_its_angles_without_the_dark_ones():
    points = ScatteredPoints(
        np.array([[0.1, -0.2], [0.3, 0.4], [-0.5, 0.0]]), np.array([0.5, 2.0, np.inf]), np.array([4.0, 0.0, 9.0])
    )
    cloud = table_points(points, initial_phase=RANDOM)
    np.testing.assert_allclose(cloud.field_tan, [[np.tan(0.1), -np.tan(0.2)], [-np.tan(0.5), 0]])
    np.testing.assert_array_equal(cloud.distance_m, [0.5, np.inf])
    np.testing.assert_array_equal(cloud.amplitude, [2, 3])
    np.testing.assert_array_equal(cloud.phase_rad, RANDOM.at(np.zeros((3, 2)))[[0, 2]])


def test_a_point_too_near_to_be_shown_is_refused_with_its_table_unless_it_is_dark():
    angles, distances = np.zeros((2, 2)), np.array([1.0, 1e-9])
    dark = ScatteredPoints(angles, distances, np.array([1.0, 0.0]))
    assert len(table_points(dark, initial_phase=RANDOM)) == 1
    with pytest.raises(InputError, match="distance is 1e-09 m; the limit is 1e-06 m"):
        table_points(ScatteredPoints(angles, distances, np.ones(2)), initial_phase=RANDOM)


# -- layers -----------------------------------------------------------------------------------------------------------


def test_a_pixel_of_a_layer_is_where_its_ray_meets_the_layers_plane():
    image = np.zeros((6, 10), np.float32)
    image[1, 8], image[4, 0] = 4.0, 0.25
    (cloud,) = layer_points(Layers((Layer(image, 0.5),)), fov_rad=FOV, initial_phase=RANDOM)
    half = np.tan(np.array(FOV) / 2)
    expected = [(0.7 * half[0], 0.5 * half[1]), (-0.9 * half[0], -0.5 * half[1])]  # (2 j + 1 - n) / n; row 0 on top
    np.testing.assert_allclose(cloud.field_tan, expected)
    np.testing.assert_allclose(places(cloud), 0.5 * np.column_stack([expected, np.ones(2)]))
    np.testing.assert_allclose(cloud.amplitude, [2, 0.5])
    np.testing.assert_array_equal(cloud.phase_rad, RANDOM(*image_tangents(10, 6, FOV))[[1, 4], [8, 0]])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_a_nearer_mask_covers_is_dimmed_by_it_whatever_the_sizes_and_the_order(seed):
    rng = np.random.default_rng(seed)
    layers = []
    for depth in rng.permutation([0.3, 0.7, np.inf]):
        shape = tuple(rng.integers(1, 9, 2))
        mask = rng.choice([0, 0.25, 1], shape).astype(np.float32)
        layers.append(Layer(rng.uniform(0.5, 1, shape).astype(np.float32), float(depth), mask))
    clouds = layer_points(Layers(tuple(layers)), fov_rad=FOV, initial_phase=ZeroPhase())
    found = {depth: np.zeros(0) for depth in (0.3, 0.7, np.inf)}
    for cloud in clouds:
        depth = min(found, key=lambda d: 0 if d == places_depth(cloud) else 1)
        found[depth] = cloud
    for layer in layers:
        rows, columns = layer.intensity.shape
        expected = np.zeros((rows, columns))
        for row in range(rows):
            for column in range(columns):
                light = layer.intensity[row, column] * layer.mask[row, column]
                for nearer in (other for other in layers if other.depth_m < layer.depth_m):
                    high, wide = nearer.mask.shape
                    # the pixel whose area holds this pixel's centre, in shares of the field
                    light *= (
                        1
                        - nearer.mask[
                            int((row + 0.5) / rows * high + 1e-9), int((column + 0.5) / columns * wide + 1e-9)
                        ]
                    )
                expected[row, column] = light
        cloud = found[layer.depth_m]
        seen = picture(cloud, (rows, columns)) if len(cloud) else np.zeros((rows, columns))
        np.testing.assert_allclose(seen, expected, rtol=1e-6)


def places_depth(cloud):
    """z of the plane that a cloud lies in."""
    depth = cloud.distance_m / np.sqrt(1 + np.sum(cloud.field_tan**2, axis=1))
    assert np.all(depth == depth[0]) or np.ptp(depth) < 1e-12
    return float(depth[0]) if np.isinf(depth[0]) else round(float(depth[0]), 9)


def test_clouds_come_nearest_first_one_per_depth_and_none_for_a_dark_layer():
    light, dark = np.ones((2, 3), np.float32), np.zeros((2, 3), np.float32)
    layers = (Layer(light, np.inf), Layer(light, 0.4), Layer(dark, 0.2), Layer(light, 0.4), Layer(light, 1.0))
    clouds = layer_points(Layers(layers), fov_rad=FOV, initial_phase=RANDOM)
    assert [places_depth(cloud) for cloud in clouds] == [0.4, 1.0, np.inf]
    assert [len(cloud) for cloud in clouds] == [12, 6, 6]
    assert len(set(np.concatenate([cloud.phase_rad for cloud in clouds]))) == 24  # independent where random


@pytest.mark.parametrize(
    ("occlusion", "masked", "behind"),
    [(None, False, 2), (None, True, 1), (True, False, 1), (True, True, 1), (False, True, 2)],
)
def test_layers_hide_by_their_masks_or_where_asked_by_their_light_or_not_at_all(occlusion, masked, behind):
    near = np.array([[1.0, 0.0]], np.float32)
    scene = Layers((Layer(near, 0.3, near if masked else None), Layer(np.ones((1, 2), np.float32), 1.0)), occlusion)
    clouds = layer_points(scene, fov_rad=FOV, initial_phase=ZeroPhase())
    assert [len(cloud) for cloud in clouds] == [1, behind]
    assert clouds[0].field_tan[0, 0] < 0 and clouds[1].field_tan[-1, 0] > 0


def test_a_scene_of_no_layers_is_refused():
    with pytest.raises(InputError, match="no layers"):
        layer_points(Layers(()), fov_rad=FOV, initial_phase=ZeroPhase())


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 12), to_infinity=st.booleans())
def test_an_image_with_depths_is_split_once_into_planes_even_in_dioptres(seed, count, to_infinity):
    rng = np.random.default_rng(seed)
    shape = (5, 8)
    depth = rng.uniform(0.2, 4.0, shape)
    depth[0, 0] = np.inf if to_infinity else 4.0
    image = rng.uniform(0.5, 1, shape).astype(np.float32)
    image[2, 3], depth[2, 3] = 0, 0.01  # a dark pixel's depth does not count
    clouds = depth_image_points(DepthImage(image, depth, count), fov_rad=FOV, initial_phase=RANDOM)
    total = sum(picture(cloud, shape) for cloud in clouds)
    np.testing.assert_allclose(total, image, rtol=1e-6)
    assert sum(len(cloud) for cloud in clouds) == image.size - 1
    lit = image > 0
    near, far = 1 / depth[lit].min(), 1 / depth[lit].max()
    planes = np.array([1 / places_depth(cloud) for cloud in clouds])
    assert np.all(np.diff(planes) < 0)
    if count > 1:
        assert (planes[0], planes[-1]) == (pytest.approx(near), pytest.approx(far, abs=1e-9))
        steps = (near - planes) / ((near - far) / (count - 1))
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    for cloud, plane in zip(clouds, planes, strict=True):
        inside = picture(cloud, shape) > 0
        assert np.abs(1 / depth[inside] - plane).max() <= (near - far) / 2 / max(count - 1, 1) * (1 + 1e-6)
    phases = {tuple(t): p for c in clouds for t, p in zip(c.field_tan, c.phase_rad, strict=True)}
    x_tan, y_tan = image_tangents(8, 5, FOV)
    assert phases[x_tan[6], y_tan[1]] == RANDOM(x_tan, y_tan)[1, 6]


# -- light fields -----------------------------------------------------------------------------------------------------

SHAPE = (40, 60)  # rows, columns


def three_by_three(step_m):
    """Places in the pupil, further apart in x than in y, and not centred."""
    return [(step_m[0] * (i + 0.0), step_m[1] * (j - 1.0)) for j in range(3) for i in range(3)]


@pytest.mark.parametrize("converging", [False, True])
def test_views_of_a_point_in_their_plane_all_become_that_point_with_one_phase(converging):
    distance = 0.4
    x_tan, y_tan = image_tangents(SHAPE[1], SHAPE[0], FOV)
    # one pixel of disparity from view to view in x, two in y: the point is at a pixel's centre in each
    pitch = np.array([x_tan[1] - x_tan[0], y_tan[0] - y_tan[1]])
    centres = three_by_three(pitch * (1, 2) * distance)
    point = np.array([x_tan[44] * distance, y_tan[9] * distance, distance])
    views = []
    for q in centres:
        t = point[:2] / distance if converging else (point[:2] - q) / distance
        image = np.zeros(SHAPE, np.float32)
        image[np.abs(y_tan - t[1]).argmin(), np.abs(x_tan - t[0]).argmin()] = 4.0
        views.append(View(image, q))
    scene = LightField(tuple(views), distance, 5e-4, converging)
    clouds = light_field_points(scene, fov_rad=FOV, initial_phase=RANDOM)
    assert len(clouds) == 9
    for cloud, q in zip(clouds, centres, strict=True):
        np.testing.assert_allclose(places(cloud), [point], rtol=0, atol=1e-12)
        np.testing.assert_allclose(cloud.amplitude, [2])
        assert (cloud.aperture.centre_m, cloud.aperture.diameter_m) == (q, 5e-4)
    assert len({float(cloud.phase_rad[0]) for cloud in clouds}) == 1
    # other points of the plane have other phases
    everywhere = [View(np.ones(SHAPE, np.float32), q) for q in centres]
    (first, *_) = light_field_points(
        LightField(tuple(everywhere), distance, 5e-4, converging), fov_rad=FOV, initial_phase=RANDOM
    )
    assert len(set(first.phase_rad)) == SHAPE[0] * SHAPE[1]


@settings(max_examples=40, deadline=None)
@given(
    row=st.integers(0, SHAPE[0] - 1),
    column=st.integers(0, SHAPE[1] - 1),
    q=st.tuples(st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3)),
    plane=st.sampled_from([0.25, 1.0, 7.0, np.inf]),
    at=st.floats(0.2, 10),
)
def test_the_point_of_a_parallel_views_pixel_lies_on_its_ray_whatever_the_plane(row, column, q, plane, at):
    x_tan, y_tan = image_tangents(SHAPE[1], SHAPE[0], FOV)
    seen = np.array([x_tan[column] * at + q[0], y_tan[row] * at + q[1], at])  # t = ((X, Y) - q) / Z
    image = np.zeros(SHAPE, np.float32)
    image[row, column] = 1
    (cloud,) = light_field_points(LightField((View(image, q),), plane), fov_rad=FOV, initial_phase=ZeroPhase())
    assert cloud.aperture is None
    ray = seen - (*q, 0)
    if np.isinf(plane):
        assert np.isinf(cloud.distance_m[0])
        np.testing.assert_allclose(cloud.field_tan[0], ray[:2] / ray[2], atol=1e-12)
    else:
        assert places(cloud)[0, 2] == pytest.approx(plane)
        np.testing.assert_allclose((places(cloud)[0] - (*q, 0)) / plane, ray / at, atol=1e-12)


def test_at_infinity_views_have_phase_by_pixel_and_dark_views_are_left_out():
    rng = np.random.default_rng(0)
    images = [rng.uniform(0.1, 1, SHAPE).astype(np.float32), np.zeros(SHAPE, np.float32)]
    images.append(rng.uniform(0.1, 1, SHAPE).astype(np.float32))
    views = tuple(View(image, (1e-3 * i, 0.0)) for i, image in enumerate(images))
    clouds = light_field_points(LightField(views, aperture_m=1e-3), fov_rad=FOV, initial_phase=RANDOM)
    assert [cloud.aperture.centre_m for cloud in clouds] == [(0.0, 0.0), (2e-3, 0.0)]
    for cloud, image in zip(clouds, images[::2], strict=True):
        np.testing.assert_array_equal(cloud.phase_rad, RANDOM(*image_tangents(SHAPE[1], SHAPE[0], FOV)).ravel())
        np.testing.assert_allclose(picture(cloud, SHAPE), image, rtol=1e-6)


def test_a_smooth_phase_is_one_function_of_the_place_to_half_a_pixel():
    phase = QuadraticPhase(515e-9, FOV, 3e-3)
    ones = np.ones(SHAPE, np.float32)
    views = tuple(View(ones, q) for q in three_by_three((0.9e-3, 0.7e-3)))
    x_tan, _ = image_tangents(SHAPE[1], SHAPE[0], FOV)
    pitch = x_tan[1] - x_tan[0]
    for cloud in light_field_points(LightField(views, 0.1, 1e-3), fov_rad=FOV, initial_phase=phase):
        slope = 2 * np.pi / 515e-9 * 1.5e-3  # at most, radians per tangent: the rim of the pupil
        assert np.abs(cloud.phase_rad - phase.at(cloud.field_tan)).max() < slope * pitch * np.sqrt(0.5)


def test_views_of_two_sizes_and_planes_too_near_are_refused():
    views = (View(np.ones((4, 5), np.float32), (0.0, 0.0)), View(np.ones((5, 4), np.float32), (1e-3, 0.0)))
    with pytest.raises(InputError, match=r"shapes \[\(4, 5\), \(5, 4\)\]"):
        light_field_points(LightField(views), fov_rad=FOV, initial_phase=ZeroPhase())
    with pytest.raises(InputError, match="displaced by up to"):
        light_field_points(LightField(views[1:], 1e-6), fov_rad=FOV, initial_phase=ZeroPhase())
