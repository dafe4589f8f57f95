"""Pixel values from the smallest denormal to the largest double: the same frame at any scale, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import InputError
from holocal.hologram.pipeline import HologramSettings, render, render_image
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import Direct, Warped, Zones
from holocal.optics.bench import Bench, Panel

DEG = np.pi / 180
BASE = HologramSettings(Panel(64, 48, 3.74e-6), Bench(), 515e-9, (8 * DEG, 6 * DEG), iterations=4)
METHODS = {"patches": Warped(), "zones": Zones(2), "direct": Direct()}
SCALES = [5e-324, 1e-310, 1e-300, 1e-80, 1e-45, 1e-30, 1e30, 1e76, 1e80, 1e300, 1.7e308]


def picture():
    return np.random.default_rng(0).uniform(0.3, 1, (3, 3))


def differing_levels(one, other):
    """Return the share of pixels whose levels differ by more than one."""
    away = (one.levels.astype(int) - other.levels + 128) % 256 - 128
    return np.mean(np.abs(away) > 1)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", SCALES)
def test_the_frame_does_not_depend_on_the_scale_of_the_picture(scale, method):
    chosen = replace(BASE, method=METHODS[method])
    image = np.ones((3, 3)) if scale < 1e-300 else picture()  # denormals have no digits for a picture
    one, scaled = (render_image(s * image, chosen, seed=0) for s in (1.0, scale))
    assert differing_levels(one, scaled) < 1e-3  # float32 rounding, through four iterations
    assert scaled.efficiency == pytest.approx(one.efficiency, rel=1e-4)
    assert any("the scene's scale" in s for s in scaled.skipped) is not (1e-24 <= scale * image.max() <= 1e24)


@pytest.mark.parametrize(("dim", "bright"), [(1e-30, 1e30), (5e-324, 1.7e308), (0.0, 5e-324), (1e-12, 1.0)])
def test_beside_a_bright_point_dim_ones_are_as_dark_as_they_are(dim, bright):
    image = np.full((5, 5), dim)
    image[1, 3] = bright
    alone = np.zeros((5, 5))
    alone[1, 3] = 1.0
    mixed, single = (render_image(i, BASE, seed=0) for i in (image, alone))
    # a share of 1e-6 in amplitude at most; where the encoder stops on a plateau it may stop an iteration later
    assert differing_levels(mixed, single) < 0.02
    assert mixed.efficiency > 0.9


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("image", [np.zeros((7, 5)), np.full((7, 5), -0.0), np.zeros((1, 1), np.uint8)], ids=str)
def test_an_all_black_picture_is_a_uniform_frame(image, method):
    rendered = render_image(image, replace(BASE, method=METHODS[method]), seed=0, keep_complex=True)
    assert not rendered.levels.any()
    assert not rendered.phase_rad.any()
    assert not rendered.field.any()
    assert rendered.efficiency == 0


@pytest.mark.parametrize("method", METHODS)
def test_no_points_and_no_clouds_are_a_uniform_frame(method):
    none = PointCloud(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
    for scene in ([], [none], [none, none]):
        assert not render(scene, replace(BASE, method=METHODS[method])).levels.any()


@pytest.mark.parametrize("dtype", [np.bool_, np.uint8, np.int64, np.float16, np.float32, np.float64, np.longdouble])
def test_one_bright_pixel_of_any_type_is_a_point(dtype):
    image = np.zeros((5, 7), dtype)
    image[2, 3] = 1
    rendered = render_image(image, BASE, seed=0)
    assert rendered.efficiency > 0.95
    assert rendered.levels.tobytes() == render_image(image.astype(float), BASE, seed=0).levels.tobytes()


@pytest.mark.parametrize("shape", [(1, 1), (1, 13), (13, 1), (2, 1), (7, 11), (61, 1)])
def test_pictures_of_one_line_and_of_odd_sizes_are_shown(shape):
    rendered = render_image(np.ones(shape), BASE, seed=0)
    assert rendered.efficiency > 0.2
    assert np.all(np.isfinite(rendered.phase_rad))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -5e-324, -1e-30, -1.0], ids=str)
@pytest.mark.parametrize("place", [(0, 0), (2, 4)])
def test_values_that_are_no_intensity_are_refused(value, place):
    image = np.ones((3, 5))
    image[place] = value
    with pytest.raises(InputError):
        render_image(image, BASE, seed=0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"amplitude": np.array([np.nan])},
        {"amplitude": np.array([-1e-300])},
        {"amplitude": np.array([np.inf])},
        {"phase_rad": np.array([np.nan])},
        {"phase_rad": np.array([np.inf])},
        {"phase_rad": np.array([1e10])},
        {"phase_rad": np.array([-1e300])},
        {"field_tan": np.array([[np.nan, 0.0]])},
        {"field_tan": np.array([[0.0, 1e300]])},
        {"field_tan": np.array([[-1e7, 0.0]])},
        {"distance_m": np.array([0.0])},
        {"distance_m": np.array([-1.0])},
        {"distance_m": np.array([np.nan])},
        {"distance_m": np.array([1e-9])},
    ],
    ids=str,
)
@pytest.mark.parametrize("method", METHODS)
def test_points_that_cannot_be_shown_are_refused(wrong, method):
    good = PointCloud(np.zeros((1, 2)), np.ones(1), np.ones(1), np.zeros(1))
    with pytest.raises(InputError) as caught:
        render([replace(good, **wrong)], replace(BASE, method=METHODS[method]))
    assert caught.value.what


@given(st.floats(-1e8, 1e8))
@settings(deadline=None, max_examples=20, derandomize=True)
def test_a_turn_more_of_initial_phase_changes_nothing(phase):
    scene = PointCloud(np.array([[0.01, 0.0], [-0.02, 0.01]]), np.full(2, np.inf), np.ones(2), np.array([0.3, phase]))
    reduced = replace(scene, phase_rad=np.array([0.3, np.angle(np.exp(1j * phase))]))
    one, other = (render([s], replace(BASE, iterations=0), keep_complex=True).field for s in (scene, reduced))
    # 1e8 rad are held to 1e-8; float32 leaves 1e-6 of two points' field
    assert np.abs(one - other).max() < 1e-5


def test_the_same_scene_gives_the_same_bytes_from_one_thread_and_from_two():
    import torch

    image = np.random.default_rng(0).random((30, 40))
    chosen = replace(BASE, panel=Panel(301, 211, 3.74e-6), iterations=5)
    before = torch.get_num_threads()
    try:
        frames = []
        for threads in (1, 2, 2, 1):
            torch.set_num_threads(threads)
            frames.append(render_image(image, chosen, seed=3))
    finally:
        torch.set_num_threads(before)
    assert len({frame.levels.tobytes() for frame in frames}) == 1
    assert len({frame.phase_rad.tobytes() for frame in frames}) == 1
    assert len({frame.signal_error for frame in frames}) == 1
