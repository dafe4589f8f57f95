"""``holocal capture``, and accepted maps applied to a scene."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from holocal.app.corrections import WEIGHT, corrected
from holocal.records.calibration import Accepted
from holocal.records.frames import write_frame
from holocal.records.maps import Maps, read_maps
from holocal.units import DEGREE


@pytest.fixture
def frame(workplace):
    levels = np.random.default_rng(5).integers(0, 256, (24, 32), np.uint8)
    write_frame(workplace / "frame.png", levels)
    return workplace / "frame.png"


def test_a_capture_finds_its_exposure_and_says_what_it_saw(holocal, workplace, frame):
    answer = holocal("capture", frame, "--rig", "lab-bench", "--out", "image.exr", "--png", "image.png", "--json")
    assert answer.status == 0, answer.err
    image = read_maps(workplace / "image.exr")
    counts = image.channels["counts"]
    assert 0.4 <= np.percentile(counts, 99.9) / 4095 <= 0.8
    assert image.metadata["projection"] == "rectilinear"
    assert image.metadata["field_deg"] == pytest.approx([0.4 / DEGREE, 0.3 / DEGREE])
    # 40 pixels over 0.4 rad, at the centre: 2 tan(0.2) / 40
    assert image.metadata["pixel_scale_deg"][0] == pytest.approx(np.degrees(np.arctan(2 * np.tan(0.2) / 40)))
    assert answer.json["exposure_s"] == image.metadata["exposure_s"]
    picture = cv2.imread(str(workplace / "image.png"), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint8
    assert picture.max() == 255  # a picture to look at: stretched from the darkest percent to the brightest thousandth
    assert np.corrcoef(picture.ravel(), counts.ravel())[0, 1] > 0.99


def test_a_capture_that_saturates_at_the_shortest_exposure_is_a_safety_stop(holocal, workplace, frame):
    bright = ("--set", "faults.kind=too-bright")
    answer = holocal("capture", frame, "--rig", "lab-bench", "--out", "image.exr", *bright, "--json")
    assert answer.status == 5
    assert not (workplace / "image.exr").exists()


def test_a_frame_of_another_panel_is_refused(holocal, workplace):
    write_frame(workplace / "other.png", np.zeros((24, 31), np.uint8))
    answer = holocal("capture", "other.png", "--rig", "lab-bench", "--json")
    assert answer.status == 2
    assert answer.json["error"]["measured"] == [31, 24]


def accepted(weight: np.ndarray, extent: tuple[float, float, float, float]) -> dict[str, Accepted]:
    maps = Maps({WEIGHT: weight.astype(np.float32)}, {"extent_deg": extent})
    return {"uniformity": Accepted("uniformity", "run", "", {}, maps)}


def test_a_weight_that_is_linear_in_the_tangent_is_applied_at_each_pixels_direction():
    # An oracle in closed form: bilinear interpolation is exact on a function that is linear in both tangents.
    half = np.tan(12.5 * DEGREE)
    x = half * (2 * np.arange(50) + 1 - 50) / 50
    y = half * (2 * np.arange(40) + 1 - 40)[::-1] / 40
    weight = 0.6 + 0.8 * x[None, :] - 0.5 * y[:, None]
    scene = np.random.default_rng(1).uniform(0.2, 1.0, (31, 23)).astype(np.float32)
    fov = (10 * DEGREE, 14 * DEGREE)
    found = corrected(scene, accepted(weight, (-12.5, 12.5, -12.5, 12.5)), fov_rad=fov, gaze_rad=(0.0, 0.0))
    tx = np.tan(fov[0] / 2) * (2 * np.arange(23) + 1 - 23) / 23
    ty = np.tan(fov[1] / 2) * (2 * np.arange(31) + 1 - 31)[::-1] / 31
    np.testing.assert_allclose(found, scene * (0.6 + 0.8 * tx[None, :] - 0.5 * ty[:, None]), rtol=1e-5)


def test_without_an_accepted_uniformity_the_scene_is_unchanged():
    scene = np.ones((4, 5), np.float32)
    assert corrected(scene, {}, fov_rad=(0.1, 0.1), gaze_rad=(0.0, 0.0)) is scene
