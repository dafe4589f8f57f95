"""The GenICam driver against an independent GigE Vision camera (libaravis) that serves our own frames."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from holocal.errors import BusyError, ConfigError, DeviceError, RefusedError
from rigs.bench import camera_description as registers
from rigs.bench.gige_server import GigeServer
from rigs.context import DriverContext
from rigs.genicam_camera import GenicamCamera, open_camera
from rigs.genicam_discovery import discover

pytestmark = pytest.mark.loopback

CONTEXT = DriverContext("bench-a", "bench-a.toml", (515e-9,))
SENSOR = (320, 240)
TABLE = {"driver": "genicam", "width": 320, "height": 240, "field_deg": 25.0, "pixel_format": "Mono12"}

HOLDER = f"""
import time
from rigs.context import DriverContext
from rigs.genicam_camera import open_camera
camera = open_camera({TABLE!r}, DriverContext("bench-a", "bench-a.toml", ()))
print("held", flush=True)
time.sleep(60)
"""


@dataclass
class Scene:
    """Noise that is new in every frame; what was asked for is kept, so that a test can compare."""

    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    counts: np.ndarray = field(default_factory=lambda: np.zeros((1, 1), np.uint16))
    exposure_us: int = 0

    def __call__(self, exposure_us: int, bits: int) -> np.ndarray:
        self.exposure_us = exposure_us
        # Counts follow the exposure: a driver that ignores it cannot be right by chance.
        top = (2**bits - 1) * exposure_us // 50_000
        self.counts = self.rng.integers(0, top + 1, SENSOR[::-1]).astype(np.uint16)
        return self.counts


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def server(scene: Scene) -> Iterator[GigeServer]:
    with GigeServer(scene, width=SENSOR[0], height=SENSOR[1], exposure_us=(30, 50_000), serial="C-42") as running:
        yield running


def opened(**keys: object) -> GenicamCamera:
    return open_camera(TABLE | keys, CONTEXT)


@pytest.mark.parametrize(
    "pixel_format", ["Mono8", "Mono10Packed", "Mono10p", "Mono12", "Mono12Packed", "Mono12p", "Mono16"]
)
def test_forty_frames_of_changing_exposure_are_each_the_fresh_one_pixel_by_pixel(server, scene, say, pixel_format):
    camera = opened(pixel_format=pixel_format)
    exact, ids = 0, []
    for number in range(40):
        exposure_s = camera.set_exposure((0.001, 0.0101234, 0.05)[number % 3])
        frame = camera.grab()
        exact += np.array_equal(frame.counts, scene.counts) and frame.lost_packets == 0
        ids.append(frame.frame_id)
        assert frame.exposure_s == exposure_s
        assert frame.exposure_s == pytest.approx(scene.exposure_us * 1e-6, rel=1e-12)  # whole microseconds, exactly
        assert frame.saturated_fraction == np.mean(scene.counts == camera.describe().full_scale)
    camera.close()
    say(f"{pixel_format}: {exact} of 40 frames fresh and exact")
    assert exact == 40 and server.frames == 40
    assert np.all(np.diff(ids) == 1)


def test_full_scale_is_that_of_the_pixel_format_and_the_rest_is_the_cameras_own_word(server):
    camera = opened(pixel_format="Mono12p", max_exposure_s=0.02, rotation_deg=-1.5, k1=0.01, k2=-0.02)
    facts = camera.describe()
    camera.close()
    assert (facts.full_scale, facts.bits) == (4095, 12)
    assert (facts.vendor, facts.model, facts.serial) == ("holocal", "bench on libaravis", "C-42")
    assert (facts.exposure_min_s, facts.exposure_max_s) == (pytest.approx(30e-6), pytest.approx(0.02))
    assert (facts.rotation_rad, facts.k1, facts.k2) == (pytest.approx(np.deg2rad(-1.5)), 0.01, -0.02)
    assert np.rad2deg(facts.field_rad[0]) == pytest.approx(25.0)
    assert np.tan(facts.field_rad[1] / 2) == pytest.approx(np.tan(facts.field_rad[0] / 2) * 240 / 320)


def test_a_region_of_the_sensor_is_that_region(server, scene):
    camera = opened(width=96, height=64, offset_x=21, offset_y=9)
    counts = camera.grab().counts
    camera.close()
    assert np.array_equal(counts, scene.counts[9:73, 21:117])


def test_what_a_maker_leaves_switched_on_is_switched_off(server, scene):
    automatic = (registers.EXPOSURE_AUTO, registers.GAIN_AUTO, registers.GAMMA_ENABLE)
    assert [server.register(address) for address in automatic] == [registers.CONTINUOUS] * 3
    camera = opened()
    assert [server.register(address) for address in automatic] == [registers.OFF] * 3
    found = {finding.title: finding for finding in camera.inspect()}
    for name in ("ExposureAuto", "GainAuto", "GammaEnable", "PixelFormat", "TriggerMode"):
        assert found[f"camera {name}"].ok is True
    assert found["camera PixelFormat"].measured == "Mono12"
    assert found["camera temperature"].measured == pytest.approx(42.5) and found["camera temperature"].ok
    assert found["camera packet size"].measured > 500 and found["camera packet size"].ok is None
    server.write(registers.GAMMA_ENABLE, registers.CONTINUOUS)  # as by a viewer that came in between
    assert {finding.title: finding.ok for finding in camera.inspect()}["camera GammaEnable"] is False
    camera.close()


def test_frame_numbers_rise_over_the_wrap_of_the_block_ids(server):
    camera = opened(width=16, height=16)
    blocks: list[int] = []
    number_of = camera.numbers.of
    camera.numbers.of = lambda block: (blocks.append(block), number_of(block))[1]
    ids = [camera.grab().frame_id for _ in range(160)]  # libaravis begins near 65,400 of 65,535
    camera.close()
    assert max(blocks) == 65535 and blocks[-1] < 100
    assert np.all(np.diff(ids) >= 1) and np.all(np.diff(ids) <= 2)


def test_a_camera_is_found_by_each_of_its_names_and_another_one_is_refused(server):
    for name in ({"serial": "C-42"}, {"address": "127.0.0.1"}, {"interface": "127.0.0.1"}, {"transport": "gige"}):
        opened(**name).close()
    with pytest.raises(RefusedError) as caught:
        opened(serial="C-43")
    assert "'C-43'" in str(caught.value) and "C-42" in str(caught.value)
    with pytest.raises(ConfigError, match=r"camera\.pixel_format = 'Mono14p'; the camera has Mono8"):
        opened(pixel_format="Mono14p")
    with pytest.raises(ConfigError, match=r"does not take the region of 320 x 240 pixels from \(400, 0\)"):
        opened(offset_x=400)


def test_a_camera_in_use_is_busy_for_others_and_listed_all_the_same(server):
    camera = opened()
    with pytest.raises(BusyError, match="another program's control"):
        opened()
    assert [seen.serial for seen in discover()] == ["C-42"]
    camera.grab()  # the one who has it is not disturbed
    camera.close()
    opened().close()  # and gives it back at once


def test_a_camera_whose_program_was_killed_is_had_again_at_once(server):
    holder = subprocess.Popen([sys.executable, "-c", HOLDER], stdout=subprocess.PIPE)
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        holder.kill()
    camera = opened()
    camera.grab()
    camera.close()


def test_no_camera_is_a_device_error_that_says_where_was_searched():
    with pytest.raises(DeviceError) as caught:
        opened(interface="127.0.0.1")
    assert caught.value.code == "no-camera" and "127.0.0.1" in str(caught.value)


def test_a_camera_unplugged_in_mid_run_is_a_device_error(server):
    camera = opened(timeout_s=0.5)
    camera.grab()
    server.close()
    with pytest.raises(DeviceError):
        camera.grab()
    camera.close()  # and closing does not fail on what is gone
