"""Devices that stand on their side or look through a mirror: the bench sees them upright."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from holocal.loop.devices import Frame, Shown
from holocal.records.facts import CameraFacts, SlmFacts
from rigs.mounting import MountedCamera, MountedSlm, Mounting

ALL = [Mounting(turn, mirror) for turn in (0, 90, 180, 270) for mirror in (False, True)]
PICTURE = np.arange(12, dtype=np.uint16).reshape(3, 4)


class Panel:
    def __init__(self, wrong: bool = False) -> None:
        self.wrong, self.levels = wrong, np.zeros((0, 0), np.uint8)

    def describe(self) -> SlmFacts:
        return SlmFacts(5, 3, 8e-6)

    def show(self, levels) -> Shown:
        self.levels = levels
        return Shown("other" if self.wrong else hashlib.sha256(levels.tobytes()).hexdigest(), None)

    def blank(self) -> None:
        self.levels = np.zeros((3, 5), np.uint8)


class Sensor:
    def describe(self) -> CameraFacts:
        return CameraFacts(4, 3, (0.4, 0.3), 4095, 1e-5, 1.0)

    def set_exposure(self, exposure_s: float) -> float:
        return exposure_s

    def grab(self) -> Frame:
        return Frame(PICTURE, 0.01, 1, 0.0)


@pytest.mark.parametrize("mounting", ALL)
def test_what_goes_to_the_device_comes_back(mounting):
    assert np.array_equal(mounting.to_bench(mounting.to_device(PICTURE)), PICTURE)


def test_a_quarter_turn_takes_the_right_side_to_the_top():
    assert Mounting(90).to_bench(PICTURE)[0].tolist() == PICTURE[:, -1].tolist()


def test_a_mirror_changes_left_and_right():
    assert Mounting(mirror=True).to_bench(PICTURE)[0].tolist() == [3, 2, 1, 0]


@pytest.mark.parametrize("mounting", ALL)
def test_a_camera_says_the_size_of_the_frames_it_gives(mounting):
    camera = MountedCamera(Sensor(), mounting)
    facts, counts = camera.describe(), camera.grab().counts
    assert counts.shape == (facts.height, facts.width)
    assert facts.field_rad == ((0.3, 0.4) if facts.width == 3 else (0.4, 0.3))
    assert counts.flags.c_contiguous


@pytest.mark.parametrize("mounting", ALL)
def test_a_panel_vouches_for_the_levels_it_was_given(mounting):
    panel = Panel()
    mounted = MountedSlm(panel, mounting)
    facts = mounted.describe()
    levels = np.arange(15, dtype=np.uint8).reshape(facts.height, facts.width)
    assert mounted.show(levels).sha256 == hashlib.sha256(levels.tobytes()).hexdigest()
    assert panel.levels.shape == (3, 5)
    assert np.array_equal(mounting.to_bench(panel.levels), levels)


def test_a_panel_that_shows_something_else_is_not_covered_for():
    assert MountedSlm(Panel(wrong=True), Mounting(180)).show(np.zeros((3, 5), np.uint8)).sha256 == "other"
