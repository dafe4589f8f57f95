"""Synthetic captures and scenes are what their manifest says, can be made again, and hold what they claim."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from holocal.estimate.blocks import block_means
from holocal.estimate.brightness import fit_brightness
from holocal.estimate.thesis_map import at_size, thesis_map
from holocal.hologram.scenes.cloud import table_points
from holocal.hologram.scenes.image import RandomPhase, ZeroPhase
from holocal.hologram.scenes.layers import layer_points
from holocal.hologram.scenes.light_field import light_field_points
from holocal.hologram.scenes.mesh import Shading, mesh_points, placed
from holocal.records.files import sha256_of
from holocal.records.frames import read_counts
from holocal.records.scene_layers import read_layers
from holocal.records.scene_mesh import read_mesh
from holocal.records.scene_points import read_points
from holocal.records.scene_views import read_light_field

DATA = Path(__file__).parents[2] / "data_synthetic"


@pytest.fixture(scope="module")
def maker():
    spec = importlib.util.spec_from_file_location("data_synthetic_make", DATA / "make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pictures():
    dark = read_counts(DATA / "dark.png").astype(float)
    return np.stack([read_counts(DATA / f"white-{i}.png") - dark for i in (0, 1)])


def test_every_file_has_the_bytes_that_the_manifest_lists_and_none_is_unlisted():
    manifest = json.loads((DATA / "manifest.json").read_text())
    files = {path.name for path in DATA.iterdir() if path.is_file()} - {"make.py", "README.md", "manifest.json"}
    assert files == set(manifest)
    for name, entry in manifest.items():
        assert (sha256_of(DATA / name), (DATA / name).stat().st_size) == (entry["sha256"], entry["bytes"])
    assert sum(entry["bytes"] for entry in manifest.values()) < 2e6


def test_making_them_again_gives_the_same_pixels_and_truth(maker, tmp_path):
    maker.make(tmp_path)
    assert maker.differences(DATA, tmp_path) == []


def test_a_changed_pixel_is_told(maker, tmp_path):
    maker.make(tmp_path)
    pixels = maker.cv2.imread(str(tmp_path / "dark.png"), maker.cv2.IMREAD_UNCHANGED)
    pixels[7, 9] += 1
    maker.cv2.imwrite(str(tmp_path / "dark.png"), pixels)
    assert maker.differences(DATA, tmp_path) == ["dark.png"]


def test_both_estimators_find_the_true_brightness_and_the_fit_is_nearer(pictures):
    truth = np.load(DATA / "truth.npy").astype(float)
    assert truth.max() == pytest.approx(1.0) and truth.min() == pytest.approx(0.25, rel=1e-3)
    blocks = block_means(pictures, 15)
    found, _ = fit_brightness(blocks, np.zeros((2, 20, 20)), shown=np.ones((300, 300), bool), block_px=15, floor=0.3)
    thesis = at_size(thesis_map(pictures.mean(axis=0)), 300, 300)
    left = {}
    for name, estimate in (("fit", found.brightness), ("thesis", thesis)):
        ratio = (estimate / truth)[found.valid]
        left[name] = float(ratio.std() / ratio.mean())
    assert found.valid.mean() > 0.5
    assert left["fit"] < 0.02  # 2 frames of 3.5 % per block, some 20 independent places in 400 blocks: 1 %, and room
    assert left["thesis"] < 0.04  # the grain of a block that a Gaussian of one block leaves, 1 to 2 %, and its borders
    assert left["fit"] < left["thesis"]


def test_the_blobs_are_seen_shifted_as_the_truth_says():
    truth = json.loads((DATA / "truth.json").read_text())
    seen = read_counts(DATA / "blobs-shifted.png") - read_counts(DATA / "dark.png").astype(float)
    errors = []
    for column, row in np.array(truth["blob_places_px"]) + truth["shift_px"]:
        c, r = round(column), round(row)
        if not (8 <= c < 292 and 8 <= r < 292):
            continue
        window = np.maximum(seen[r - 7 : r + 8, c - 7 : c + 8] - 10, 0)  # 3.5 times the noise of a difference
        y, x = np.mgrid[r - 7 : r + 8, c - 7 : c + 8]
        errors.append(((window * x).sum() / window.sum() - column, (window * y).sum() / window.sum() - row))
    assert len(errors) > 60
    np.testing.assert_allclose(np.mean(errors, axis=0), 0, atol=0.15)  # 60 centroids good to some 0.3 px each


FOV = (np.radians(25.0), np.radians(25.0))


def test_a_changed_scene_is_told(maker, tmp_path):
    maker.make(tmp_path)
    for name in ("points.csv", "mesh.obj", "layers.toml"):
        (tmp_path / name).write_text((tmp_path / name).read_text().replace("0.3", "0.4", 1))
    assert sorted(maker.differences(DATA, tmp_path)) == ["layers.toml", "mesh.obj", "points.csv"]


def test_the_spiral_winds_away_counterclockwise_and_the_star_is_far_away():
    cloud = table_points(read_points(DATA / "points.csv"), initial_phase=ZeroPhase())
    spiral, star = cloud.field_tan[:-1], cloud.field_tan[-1]
    assert len(spiral) == 120
    assert (cloud.distance_m[0], cloud.distance_m[119], cloud.distance_m[120]) == (0.25, 4.0, np.inf)
    turned = np.unwrap(np.arctan2(spiral[:, 1], spiral[:, 0]))
    assert turned[-1] - turned[0] == pytest.approx(6 * np.pi, rel=1e-3)
    np.testing.assert_allclose(star, np.tan(np.radians([-9.0, 10.5])), rtol=1e-12)
    assert np.all(np.abs(cloud.field_tan) < np.tan(FOV[0] / 2))


def test_the_ring_hides_the_bars_behind_it_and_nothing_else():
    scene = read_layers(DATA / "layers.toml")
    near, far = layer_points(scene, fov_rad=FOV, initial_phase=RandomPhase(0))
    bars, ring = scene.layers[1].intensity, scene.layers[0].intensity
    assert near.distance_m.min() == pytest.approx(0.3, rel=0.01) and far.distance_m.min() == pytest.approx(2, rel=0.01)
    np.testing.assert_allclose(near.field_tan.mean(axis=0), (-0.04, 0.03), atol=0.002)
    np.testing.assert_allclose(np.sum(far.amplitude**2), np.sum(bars * (1 - ring)), rtol=1e-5)
    assert 0.7 < np.sum(bars * (1 - ring)) / np.sum(bars) < 0.9


def test_the_ball_is_before_the_box_and_neither_is_inside_out():
    mesh = placed(read_mesh(DATA / "mesh.obj"), distance_m=0.5, fov_rad=FOV)
    clouds = [
        mesh_points(
            mesh,
            fov_rad=FOV,
            pixels=(200, 200),
            shading=Shading(ambient=1.0, back_faces=back_faces),
            initial_phase=ZeroPhase(),
        )
        for back_faces in (False, True)
    ]
    for name in ("field_tan", "distance_m", "amplitude"):  # a closed surface hides its own back
        np.testing.assert_allclose(getattr(clouds[0], name), getattr(clouds[1], name), rtol=1e-9)
    ball = clouds[0].amplitude ** 2 > 0.45  # the box is 0.4
    assert 0.05 < ball.mean() < 0.5
    assert np.all(clouds[0].field_tan[ball].mean(axis=0) > clouds[0].field_tan[~ball].mean(axis=0))
    assert clouds[0].distance_m[ball].mean() < clouds[0].distance_m[~ball].mean()


def test_the_near_card_of_the_light_field_shifts_against_the_pupil_and_the_bars_do_not():
    scene = read_light_field(DATA / "light_field.toml")
    assert (scene.aperture_m, scene.distance_m, len(scene.views)) == (pytest.approx(1e-3), np.inf, 9)
    clouds = light_field_points(scene, fov_rad=FOV, initial_phase=RandomPhase(1))
    centres = []
    for cloud in clouds:
        bright = cloud.amplitude**2 > 0.9  # the card; bars are 0.35
        box = cloud.field_tan[bright]
        centres.append((box.min(axis=0) + box.max(axis=0)) / 2)
    moved = np.array(centres) - centres[4]
    places = np.array([cloud.aperture.centre_m for cloud in clouds])
    pitch = 2 * np.tan(FOV[0] / 2) / 160
    np.testing.assert_allclose(moved, -places / 0.25, atol=0.75 * pitch)  # a border is found to half a pixel
    assert np.abs(moved).max() > 1.2 * pitch
    corner = [view.intensity[:20, :20] for view in scene.views]
    assert all(np.array_equal(one, corner[0]) for one in corner)
