"""Which camera pixels the response is read from, and what is read from them."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import generator

import procedures._response_frames as frames_module
from holocal.loop.devices import Frame
from holocal.records.facts import CameraFacts
from procedures._exposure import next_guess
from procedures._response_frames import bright_counts, choose_pixels, light_of

CAMERA = CameraFacts(40, 30, (0.4, 0.3), 4095, 1e-4, 1.0)
PEDESTAL = 20.0


def frame(counts, exposure_s=0.01):
    counts = np.clip(np.rint(counts), 0, 4095).astype(np.uint16)
    return Frame(counts, exposure_s, 1, float(np.mean(counts == 4095)))


@pytest.fixture
def scene():
    """Nine frames whose left half changes from frame to frame, a dark frame, and a hot pixel in the left half."""
    rng = generator(1)
    light = np.full((9, 30, 40), 300.0)
    light[:, :, :20] += 250 * np.cos(np.arange(9)[:, None, None] + rng.uniform(0, 6, (30, 20)))
    dark = np.full((30, 40), PEDESTAL)
    dark[5, 5] = 900.0
    noise = rng.normal(0, 2, light.shape)
    frames = [frame(one + dark + extra) for one, extra in zip(light, noise, strict=True)]
    return frames, frame(dark + rng.normal(0, 2, dark.shape)).counts


def test_pixels_whose_light_changes_come_first_and_hot_ones_never(scene, monkeypatch):
    frames, dark = scene
    monkeypatch.setattr(frames_module, "MOST_PIXELS", 599)
    left = np.arange(1200).reshape(30, 40)[:, :20].ravel()
    np.testing.assert_array_equal(choose_pixels(frames, dark, CAMERA), left[left != 5 * 40 + 5])


def test_a_pixel_that_comes_near_full_scale_once_is_not_chosen(scene):
    frames, dark = scene
    counts = frames[4].counts.copy()
    counts[3, 3] = 3000  # 0.73 of full scale: at another level it would clip
    chosen = choose_pixels([*frames[:4], frame(counts), *frames[5:]], dark, CAMERA)
    assert 3 * 40 + 3 not in chosen


def test_a_camera_that_sees_only_clipped_light_gives_no_pixels():
    bright = [frame(np.full((30, 40), 5000.0))] * 9
    assert choose_pixels(bright, np.zeros((30, 40), np.uint16), CAMERA).size == 0


def test_light_is_brought_to_one_exposure_and_clipped_counts_are_unknown(scene):
    _, dark = scene
    level = dark.astype(float)
    full, half = frame(level + 400), frame(level + 200, exposure_s=0.005)
    clipped = full.counts.copy()
    clipped[0, 1] = 4095
    pixels = np.array([0, 1, 77])
    light = light_of([full, half, frame(clipped)], dark, pixels, camera=CAMERA, exposure_s=0.01)
    np.testing.assert_allclose(light[0], 400.0, atol=0.5)  # counts are whole numbers
    np.testing.assert_allclose(light[1], 400.0, atol=1.0)
    assert np.isnan(light[2, 1])
    assert np.isfinite(light[2, [0, 2]]).all()


def test_the_exposure_is_set_by_the_brightest_speckle_but_for_single_pixels():
    counts = generator(2).exponential(100.0, (300, 400)) + PEDESTAL
    counts[:3, :3] = 4000  # a cluster of hot pixels: 7e-5 of all
    # the brightest 2e-3 of exponential speckle lie above 6.2 means, the faintest hundredth below 0.01 means
    assert bright_counts(frame(counts)) == pytest.approx(100 * np.log(500), rel=0.05)


@pytest.mark.parametrize(
    ("counts", "exposure_s", "wanted"), [(5000.0, 0.01, 0.001), (PEDESTAL + 1, 0.01, 0.3), (600.0, 0.01, None)]
)
def test_an_exposure_that_clips_is_cut_to_a_tenth_and_a_faint_one_raised(counts, exposure_s, wanted):
    seen = frame(np.full((30, 40), counts), exposure_s)
    assert next_guess(seen, CAMERA, brightest=counts - PEDESTAL, last=False) == (
        None if wanted is None else pytest.approx(wanted)
    )
    assert next_guess(seen, CAMERA, brightest=counts - PEDESTAL, last=True) is None
