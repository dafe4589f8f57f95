"""``holocal capture``, and accepted maps applied to a scene."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from holocal.app.corrections import PHASE, SHIFTS, WEIGHT, corrections_of
from holocal.errors import InputError
from holocal.hologram.scenes.points import PointCloud
from holocal.optics.bench import Bench
from holocal.optics.zernike import zernike
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


def accepted(procedure: str, channels: dict[str, np.ndarray], **metadata: object) -> dict[str, Accepted]:
    maps = Maps({name: values.astype(np.float32) for name, values in channels.items()}, metadata)
    return {procedure: Accepted(procedure, "run", "", {}, maps)}


EXTENT = (-12.5, 12.5, -12.5, 12.5)
FOV = (25 * DEGREE, 25 * DEGREE)


def linear_map(start: float, x: float, y: float) -> np.ndarray:
    """Return a map over EXTENT that is linear in both tangents; bilinear interpolation is exact on it."""
    half = np.tan(12.5 * DEGREE)
    across = half * (2 * np.arange(50) + 1 - 50) / 50
    down = half * (2 * np.arange(40) + 1 - 40)[::-1] / 40
    return start + x * across[None, :] + y * down[:, None]


def points(gaze: tuple[float, float] = (0.0, 0.0)) -> tuple[PointCloud, np.ndarray]:
    """Return points inside EXTENT, and their tangents as the eye sees them, gaze or not."""
    rng = np.random.default_rng(1)
    tangents = rng.uniform(-0.15, 0.15, (80, 2))
    directions = np.concatenate([tangents, np.ones((80, 1))], axis=1) @ Bench().pupil_axes(
        gaze
    )  # into the gaze's frame
    cloud = PointCloud(
        directions[:, :2] / directions[:, 2:], np.full(80, np.inf), rng.uniform(0.2, 1, 80), np.zeros(80)
    )
    return cloud, tangents


@pytest.mark.parametrize("gaze", [(0.0, 0.0), (0.06, -0.04)])
def test_a_weight_that_is_linear_in_the_tangent_is_applied_at_each_points_direction(gaze):
    found = corrections_of(accepted("uniformity", {WEIGHT: linear_map(0.6, 0.8, -0.5)}, extent_deg=EXTENT), fov_rad=FOV)
    cloud, tangents = points(gaze)
    wanted = cloud.amplitude**2 * (0.6 + 0.8 * tangents[:, 0] - 0.5 * tangents[:, 1])
    np.testing.assert_allclose(found.apply(cloud, gaze).amplitude ** 2, wanted, rtol=1e-5)


def test_a_distortion_moves_points_and_the_brightness_is_that_of_where_they_are_shown():
    shift = {SHIFTS[0]: linear_map(0.002, 0.1, 0.0), SHIFTS[1]: linear_map(-0.001, 0.0, 0.2)}
    weight = {WEIGHT: linear_map(0.6, 0.8, -0.5)}
    both = accepted("distortion", shift, extent_deg=EXTENT) | accepted("uniformity", weight, extent_deg=EXTENT)
    cloud, tangents = points()
    found = corrections_of(both, fov_rad=FOV).apply(cloud, (0.0, 0.0))
    shown = tangents + np.stack([0.002 + 0.1 * tangents[:, 0], -0.001 + 0.2 * tangents[:, 1]], axis=-1)
    np.testing.assert_allclose(found.field_tan, shown, atol=1e-8)
    wanted = cloud.amplitude**2 * (0.6 + 0.8 * shown[:, 0] - 0.5 * shown[:, 1])
    np.testing.assert_allclose(found.amplitude**2, wanted, rtol=1e-5)


def test_zernike_maps_become_a_wavefront_over_the_field():
    maps = {"correction.noll_4_rad": linear_map(0.3, 2.0, 0.0), "correction.noll_7_rad": linear_map(-0.1, 0.0, 1.0)}
    found = corrections_of(accepted("aberration", maps, extent_deg=EXTENT, wavelength_nm=515.0), fov_rad=FOV)
    tangents, pupil = np.array([[0.1, -0.05]]), np.array([[0.6e-3, -0.9e-3]])
    phase = found.wavefront.phase(tangents, pupil, pupil_diameter_m=3e-3, wavelength_m=515e-9)
    basis = zernike((4, 7), *(pupil / 1.5e-3).T)
    assert phase[0] == pytest.approx((0.3 + 2.0 * 0.1) * basis[0, 0] + (-0.1 - 0.05) * basis[1, 0], abs=1e-6)


def test_a_response_is_handed_to_the_levels():
    phase = np.linspace(0, 5.9, 256)[None, :]
    found = corrections_of(accepted("response", {PHASE: phase}), fov_rad=FOV)
    np.testing.assert_allclose(found.response_rad(515.0, 8), phase[0], atol=1e-6)


def test_a_response_acts_on_its_own_line_only_and_says_so_at_others():
    phase = np.linspace(0, 5.9, 256)[None, :]
    found = corrections_of(accepted("response", {PHASE: phase}, wavelength_nm=515.0), fov_rad=FOV)
    np.testing.assert_allclose(found.response_rad(516.5, 8), phase[0], atol=1e-6)
    assert found.skipped(516.5) == []
    assert found.response_rad(639.0, 8) is None
    assert found.skipped(639.0) == ["the accepted response: measured at 515 nm, not at 639 nm"]


def test_a_panel_of_few_levels_is_taken_to_share_the_turn_among_them():
    table = corrections_of({}, fov_rad=FOV).response_rad(515.0, 4)
    np.testing.assert_allclose(table, 2 * np.pi * np.arange(16) / 16)
    short = accepted("response", {PHASE: np.linspace(0, 5.0, 16)[None]})
    np.testing.assert_allclose(corrections_of(short, fov_rad=FOV).response_rad(515.0, 4)[-1], 5.0, atol=1e-6)


@pytest.mark.parametrize("phase", [np.zeros((1, 255)), np.full((1, 256), np.nan), np.zeros((1, 1)), np.zeros((2, 256))])
def test_a_response_that_is_no_table_is_refused(phase):
    with pytest.raises(InputError, match="a power of two"):
        corrections_of(accepted("response", {PHASE: phase}), fov_rad=FOV)


def test_corrections_that_change_nothing_are_left_out_and_named():
    nothing = (
        accepted("uniformity", {WEIGHT: np.ones((4, 4))}, extent_deg=EXTENT)
        | accepted("distortion", {name: np.zeros((4, 4)) for name in SHIFTS}, extent_deg=EXTENT)
        | accepted("aberration", {"correction.noll_4_rad": np.zeros((4, 4))}, extent_deg=EXTENT, wavelength_nm=515.0)
        | accepted("response", {PHASE: 2 * np.pi * np.arange(256)[None, :] / 256})
    )
    found = corrections_of(nothing, fov_rad=FOV)
    assert found.identities == ("uniformity", "distortion", "aberration", "response")
    cloud, _ = points()
    assert found.apply(cloud, (0.0, 0.0)) is cloud
    assert found.wavefront is None
    assert found.response is None


@pytest.mark.parametrize("procedure", ["uniformity", "distortion", "aberration", "response"])
def test_a_calibration_without_its_channels_is_refused_by_name(procedure):
    with pytest.raises(InputError, match=f"the {procedure} calibration run"):
        corrections_of(accepted(procedure, {"other": np.ones((2, 2))}), fov_rad=FOV)


def test_without_accepted_corrections_a_cloud_is_unchanged():
    cloud, _ = points()
    assert corrections_of({}, fov_rad=FOV).apply(cloud, (0.0, 0.0)) is cloud
