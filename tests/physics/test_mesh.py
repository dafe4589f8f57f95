"""A mesh becomes what a ray through each pixel meets first, where it meets it, as bright as it is there."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import InputError
from holocal.hologram.scenes.image import RandomPhase, ZeroPhase
from holocal.hologram.scenes.mesh import Shading, mesh_points, placed
from holocal.optics.bench import image_tangents
from holocal.records.scene_data import Mesh

FOV = (0.5, 0.3)  # wider than high, so that x and y cannot be swapped
PIXELS = (25, 18)
FLAT = Shading(ambient=1.0)  # every surface as bright as its colour


def made(vertices, faces, intensity=None):
    faces = np.asarray(faces, np.int64)
    return Mesh(np.asarray(vertices, float), faces, np.ones(faces.shape) if intensity is None else intensity)


def placed_in_space(cloud):
    """The points' places (n, 3) in P, from their tangents and distances."""
    directions = np.column_stack([cloud.field_tan, np.ones(len(cloud))])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * cloud.distance_m[:, None]


def met_first(mesh, direction):
    """z and the least barycentric weight of the first hit of a ray from the origin, by Moeller and Trumbore."""
    best = (np.inf, 1.0)
    doubtful = False
    for face in mesh.faces:
        a, b, c = mesh.vertices_m[face]
        across = np.cross(direction, c - a)
        volume = (b - a) @ across
        u = -a @ across / volume
        v = direction @ np.cross(-a, b - a) / volume
        z = (c - a) @ np.cross(-a, b - a) / volume
        least = min(u, v, 1 - u - v)
        doubtful |= abs(least) < 1e-6 or abs(z - 0.01) < 1e-6
        if least >= 0 and 0.01 <= z < best[0]:
            best = (z, least)
    return best[0], doubtful


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), nearest=st.sampled_from([0.3, 0.005, -0.5]))
def test_each_pixel_shows_what_a_ray_meets_first_also_where_triangles_pass_behind_the_eye(seed, nearest):
    rng = np.random.default_rng(seed)
    z = rng.uniform(nearest, 2.0, (9, 3, 1))
    across = rng.uniform(-1, 1, (9, 3, 2)) * np.tan(np.array(FOV) / 2) * 1.5 * np.maximum(np.abs(z), 0.2)
    triangles = np.concatenate([across, z], axis=-1)
    mesh = made(triangles.reshape(-1, 3), np.arange(27).reshape(-1, 3))
    columns, rows = PIXELS
    x_tan, y_tan = image_tangents(columns, rows, FOV)
    expected, ignored = {}, set()
    for row in range(rows):
        for column in range(columns):
            depth, doubtful = met_first(mesh, np.array([x_tan[column], y_tan[row], 1.0]))
            if doubtful:  # an edge, to rounding
                ignored.add((row, column))
            elif np.isfinite(depth):
                expected[row, column] = depth
    if not expected:
        return
    cloud = mesh_points(mesh, fov_rad=FOV, pixels=PIXELS, shading=FLAT, initial_phase=ZeroPhase())
    column = np.abs(cloud.field_tan[:, :1] - x_tan).argmin(axis=1)
    row = np.abs(cloud.field_tan[:, 1:] - y_tan).argmin(axis=1)
    depths = placed_in_space(cloud)[:, 2]
    found = {(int(r), int(c)): depth for r, c, depth in zip(row, column, depths, strict=True) if (r, c) not in ignored}
    assert found.keys() == expected.keys()
    np.testing.assert_allclose([found[key] for key in expected], list(expected.values()), rtol=1e-9)


def test_a_patch_up_and_to_plus_x_is_seen_there_at_its_distance():
    # 2 cm wide and 1 cm high about (0.1, 0.05, 1) m: tangents 0.09 to 0.11 and 0.045 to 0.055
    patch = made([(0.09, 0.045, 1), (0.11, 0.045, 1), (0.11, 0.055, 1), (0.09, 0.055, 1)], [(0, 1, 2), (0, 2, 3)])
    cloud = mesh_points(patch, fov_rad=FOV, pixels=(500, 300), shading=FLAT, initial_phase=ZeroPhase())
    pitch = 2 * np.tan(np.array(FOV) / 2) / (500, 300)
    np.testing.assert_allclose(cloud.field_tan.min(axis=0), (0.09, 0.045), atol=pitch.max())
    np.testing.assert_allclose(cloud.field_tan.max(axis=0), (0.11, 0.055), atol=pitch.max())
    np.testing.assert_allclose(cloud.distance_m, np.sqrt(1 + np.sum(cloud.field_tan**2, axis=1)), rtol=1e-12)
    assert len(cloud) == pytest.approx(0.02 * 0.01 / pitch.prod(), rel=0.1)  # two of its borders are a pixel uncertain
    assert np.all(np.diff(cloud.field_tan[:, 1]) <= 0)  # row 0 is the largest y


def test_a_triangle_that_is_a_quarter_of_the_view_leaves_no_crack_to_its_neighbour():
    # a fan of slanted triangles about the gaze that together cover the view: every pixel once
    rim = np.array([(1, 0.1), (0.2, 1), (-1, 0.4), (-0.7, -1), (0.5, -0.9)]) * 3
    vertices = [(0, 0, 1.5), *((x, y, 1 + 0.2 * i) for i, (x, y) in enumerate(rim))]
    fan = made(vertices, [(0, i + 1, (i + 1) % 5 + 1) for i in range(5)])
    cloud = mesh_points(fan, fov_rad=FOV, pixels=(101, 99), shading=FLAT, initial_phase=ZeroPhase())
    assert len(cloud) == 101 * 99


def test_colour_is_interpolated_along_the_surface_not_along_the_picture():
    vertices = np.array([(-0.2, -0.1, 0.5), (0.9, -0.2, 3.0), (0.1, 0.5, 1.4)])
    slope = np.array([0.3, -0.2, 0.25])
    faces = np.array([[2, 0, 1]])
    mesh = made(vertices, faces, 0.5 + vertices[faces] @ slope)
    cloud = mesh_points(mesh, fov_rad=(0.8, 0.6), pixels=(60, 50), shading=FLAT, initial_phase=RandomPhase(3))
    assert len(cloud) > 300
    np.testing.assert_allclose(cloud.amplitude**2, 0.5 + placed_in_space(cloud) @ slope, rtol=1e-9)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_surface_is_as_bright_as_its_angle_to_the_light_says(smooth):
    # a plane z = 1 + 0.5 x, whose side towards the eye has the normal (0.5, 0, -1)
    vertices = [(x, y, 1 + 0.5 * x) for x, y in [(-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5), (0.5, -0.5)]]
    plane = made(vertices, [(0, 1, 2), (0, 2, 3)])
    shading = Shading(light=(3.0, 1.0, -1.0), ambient=0.25, smooth=smooth)
    cosine = (0.5 * 3 + 1) / (np.sqrt(1.25) * np.sqrt(11))
    for one in (plane, made(plane.vertices_m, plane.faces[:, ::-1])):  # from behind, a face is lit as if turned round
        cloud = mesh_points(one, fov_rad=FOV, pixels=PIXELS, shading=shading, initial_phase=ZeroPhase())
        np.testing.assert_allclose(cloud.amplitude**2, 0.25 + 0.75 * cosine, rtol=1e-9)


def sphere(rings=24, sectors=40):
    """A unit sphere with its seam doubled, as a textured one has it; corners counterclockwise from outside."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, sectors + 1), indexing="ij")
    vertices = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    vertices = vertices.round(12)  # so that 0 and 2 pi are one place
    index = np.arange(vertices[..., 0].size).reshape(polar.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return made(vertices.reshape(-1, 3), faces)


def test_a_smooth_sphere_is_lit_like_a_sphere_across_its_seam():
    ball = sphere()
    ball = made(ball.vertices_m + np.array([0, 0, 8.0]), ball.faces)
    light = np.array([0.9, 0.2, -0.5]) / np.linalg.norm([0.9, 0.2, -0.5])
    errors = {}
    for smooth in (False, True):
        shading = Shading(light=tuple(light), ambient=0.1, smooth=smooth, back_faces=False)
        cloud = mesh_points(ball, fov_rad=(0.3, 0.3), pixels=(60, 60), shading=shading, initial_phase=ZeroPhase())
        normal = placed_in_space(cloud) - (0, 0, 8.0)
        ideal = 0.1 + 0.9 * np.maximum(normal / np.linalg.norm(normal, axis=1, keepdims=True) @ light, 0)
        errors[smooth] = np.abs(cloud.amplitude**2 - ideal)
    assert errors[True].max() < 0.02  # facets are 0.15 rad: normals between vertices are good to 0.15^2
    assert errors[False].max() > 0.05


def test_faces_that_are_not_seen_from_behind_are_left_out():
    towards = made([(-0.5, -0.5, 1), (0, 0.5, 1), (0.5, -0.5, 1)], [(0, 1, 2)])  # n = (0, 0, -1): towards the eye
    away = made(towards.vertices_m, [(2, 1, 0)])
    one_sided = Shading(ambient=1.0, back_faces=False)
    assert len(mesh_points(towards, fov_rad=FOV, pixels=PIXELS, shading=one_sided, initial_phase=ZeroPhase()))
    with pytest.raises(InputError, match="inside out"):
        mesh_points(away, fov_rad=FOV, pixels=PIXELS, shading=one_sided, initial_phase=ZeroPhase())


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), distance=st.floats(0.1, 20), share=st.floats(0.1, 1.5), facing=st.booleans())
def test_a_placed_mesh_reaches_just_its_share_of_the_field(seed, distance, share, facing):
    rng = np.random.default_rng(seed)
    mesh = made(rng.normal(size=(12, 3)) * rng.uniform(0.01, 100, 3) + rng.normal(size=3) * 50, [(0, 1, 2), (3, 4, 5)])
    found = placed(mesh, distance_m=distance, fov_rad=FOV, share=share, facing_eye=facing).vertices_m
    assert np.all(found[:, 2] > 0)
    reached = np.abs(found[:, :2] / found[:, 2:]) / np.tan(np.array(FOV) / 2)
    assert reached.max() == pytest.approx(share, rel=1e-9)
    assert (found[:, 2].min() + found[:, 2].max()) / 2 == pytest.approx(distance, rel=1e-9)


def test_a_placed_mesh_shows_its_front_upright_not_mirrored_and_not_inside_out():
    # in modelling axes: a small bright face before (z = 1) a large dark one, towards +x and +y; both face the viewer
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    front, back = np.c_[square * 0.2 + (0.5, 0.6), np.ones(4)], np.c_[square, -np.ones(4)]
    faces = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)])
    mesh = made(np.r_[front, back], faces, np.repeat([[1.0], [0.25]], 2, axis=0) * np.ones(3))
    one_sided = Shading(ambient=1.0, back_faces=False)
    there = placed(mesh, distance_m=1.0, fov_rad=FOV)
    cloud = mesh_points(there, fov_rad=FOV, pixels=(100, 60), shading=one_sided, initial_phase=ZeroPhase())
    bright = cloud.amplitude > 0.9
    assert np.all(cloud.field_tan[bright].mean(axis=0) > 0.01) and 0 < bright.mean() < 0.2
    assert placed_in_space(cloud)[bright, 2].max() < placed_in_space(cloud)[~bright, 2].min()
    turned = placed(mesh, distance_m=1.0, fov_rad=FOV, facing_eye=False)
    with pytest.raises(InputError, match="inside out"):
        mesh_points(turned, fov_rad=FOV, pixels=(100, 60), shading=one_sided, initial_phase=ZeroPhase())


@pytest.mark.parametrize(
    ("shift", "said"),
    [
        (
            (2.0, 0, 1),
            r"in view: it spans x from 1\.9 to 2\.1 m, .* seen from 62\.2 to 64\.5 degrees in x .* 28\.65 x ",
        ),
        ((0, 0, -1), "behind the eye"),
        ((0, 0, 0.005), "behind the eye or nearer than 0.01 m"),
    ],
)
def test_a_mesh_out_of_view_is_refused_saying_where_it_is_and_where_the_view_is(shift, said):
    mesh = made(np.array([(-0.1, -0.1, 0), (0.1, -0.1, 0), (0, 0.1, 0)]) + shift, [(0, 1, 2)])
    with pytest.raises(InputError, match=said):
        mesh_points(mesh, fov_rad=FOV, initial_phase=ZeroPhase())


def test_a_mesh_without_light_is_refused():
    mesh = made([(-0.5, -0.5, 1), (0, 0.5, 1), (0.5, -0.5, 1)], [(0, 1, 2)])
    with pytest.raises(InputError, match="dark everywhere"):
        mesh_points(mesh, fov_rad=FOV, shading=Shading((0, 0, 1), 0.0), initial_phase=ZeroPhase())


@pytest.mark.parametrize("wrong", [{"light": (0.0, 0.0, 0.0)}, {"light": (np.nan, 0.0, 1.0)}, {"ambient": 1.5}])
def test_shading_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError, match=re.escape(next(iter(wrong))) + "|light's"):
        Shading(**wrong)


def test_a_mesh_at_one_place_cannot_be_placed():
    with pytest.raises(InputError, match="no extent"):
        placed(made(np.ones((3, 3)), [(0, 1, 2)]), distance_m=1.0, fov_rad=FOV)


def test_the_phase_of_a_pixel_does_not_depend_on_what_else_is_in_view():
    small = made([(0.0, 0.0, 1), (0.1, 0.0, 1), (0.0, 0.1, 1)], [(0, 1, 2)])
    both = made(np.r_[small.vertices_m, small.vertices_m * (-1, 1, 1)], [(0, 1, 2), (3, 4, 5)])
    clouds = [
        mesh_points(one, fov_rad=FOV, pixels=PIXELS, shading=FLAT, initial_phase=RandomPhase(1))
        for one in (small, both)
    ]
    phases = [{tuple(t): p for t, p in zip(c.field_tan, c.phase_rad, strict=True)} for c in clouds]
    assert phases[0].items() <= phases[1].items() and len(phases[0]) < len(phases[1])
