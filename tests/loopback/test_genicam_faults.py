"""The GenICam driver against a camera whose faults can be chosen: lost packets, slow answers, control taken away."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from lab_drivers import LabLight, LabSlm
from viva_genicam.testing import FakeGigeCamera, FakeU3vCamera

from holocal.errors import DeviceError, RefusedError
from holocal.loop import gates
from holocal.loop.procedure import Shot
from holocal.loop.shooting import Shooter
from holocal.records.facts import RigFacts
from rigs.bench.pixel_formats import FORMATS
from rigs.context import DriverContext
from rigs.devices import DevicesRig
from rigs.genicam_camera import GenicamCamera, controlled, open_camera
from rigs.genicam_table import CameraFile, GenicamTable

pytestmark = pytest.mark.loopback

CONTEXT = DriverContext("bench-a", "bench-a.toml", (515e-9,))
TABLE = {"width": 320, "height": 240, "field_deg": 25.0, "pixel_format": "Mono8", "timeout_s": 1.0}
EXPOSURE_TIME = FakeGigeCamera.REGISTERS["ExposureTime"]
FIRST, LATER, LAST = 0, 17, 54  # packets of a frame: its leader, one of the 53 of its payload, its trailer


def opened(**keys: object) -> GenicamCamera:
    return open_camera(TABLE | keys, CONTEXT)


def fake(**keys: object) -> FakeGigeCamera:
    return FakeGigeCamera(width=320, height=240, fps=200, **keys)  # type: ignore[arg-type]


def test_the_fake_sends_one_frame_per_trigger_and_none_without():
    with fake() as device:
        camera = opened()
        frames = [camera.grab() for _ in range(10)]
        camera.close()
        assert device.software_triggers() == device.blocks_sent() == 10
    assert [frame.frame_id for frame in frames] == list(range(1, 11))
    assert all(frame.lost_packets == 0 and frame.counts.any() for frame in frames)


@pytest.mark.parametrize("packet", [FIRST, LATER, LAST])
def test_a_frame_that_lost_a_packet_says_so_and_the_next_one_is_whole(packet):
    with fake(packet_resend=False, drop_packets=[(2, packet)]):
        camera = opened()
        whole, damaged, after = (camera.grab() for _ in range(3))
        camera.close()
    assert (whole.lost_packets, after.lost_packets) == (0, 0)
    assert damaged.lost_packets >= 1
    assert damaged.counts.shape == (240, 320)
    assert not gates.lost_packets(damaged).ok and gates.lost_packets(after).ok
    assert whole.frame_id < damaged.frame_id < after.frame_id


def test_the_loop_takes_a_damaged_frame_again_and_gives_up_after_two():
    incidents: list[gates.Verdict] = []
    with fake(packet_resend=False, drop_packets=[(2, LATER), (4, LATER), (5, LATER)]):
        rig = DevicesRig(LabSlm("slm", {}), opened(), LabLight("light", {}), None)  # type: ignore[arg-type]
        facts = RigFacts("bench-a", rig.slm.describe(), rig.camera.describe(), (515e-9,), 3e-3, 12e-3, False)
        shooter = Shooter(rig, facts, lambda verdict, shot, frame: incidents.append(verdict))
        shots = [Shot(f"shot {number}", np.full((9, 16), number, np.uint8), 0.01, 515e-9, 1.0) for number in range(3)]
        assert [shooter.shoot(shot).frame_id for shot in shots[:2]] == [1, 3]
        with pytest.raises(DeviceError, match="lost-packets"):
            shooter.shoot(shots[2])
        rig.camera.close()  # type: ignore[attr-defined]
    assert [verdict.gate for verdict in incidents] == ["lost-packets"] * 3


def test_packets_that_the_camera_sends_again_are_no_loss():
    with fake(packet_resend=True, drop_packets=[(1, FIRST), (2, LATER), (2, LATER + 1)]):
        camera = opened()
        frames = [camera.grab() for _ in range(3)]
        camera.close()
    assert [frame.lost_packets for frame in frames] == [0, 0, 0]


def test_a_frame_of_which_nothing_arrives_is_a_device_error_that_counts_the_packets():
    everything = [(1, packet) for packet in range(200)]
    with fake(packet_resend=False, drop_packets=everything):
        camera = opened(timeout_s=0.3)
        with pytest.raises(DeviceError) as caught:
            camera.grab()
        camera.close()
    assert caught.value.code == "camera-timeout" and caught.value.measured == 0
    assert "firewall" in str(caught.value)


def test_control_that_is_taken_away_in_mid_run_ends_it():
    with fake() as device:
        camera = opened()
        camera.grab()
        device.revoke_control()
        with pytest.raises(DeviceError, match="control") as caught:
            for _ in range(100):  # until the next heartbeat, at most 3 s
                camera.grab()
                time.sleep(0.05)
        camera.close()
    assert caught.value.exit_status == 6


def test_a_camera_that_forgets_a_dead_program_after_a_while_is_waited_for():
    with fake() as device:
        held = opened()
        forgetting = threading.Timer(0.8, device.revoke_control)  # as a heartbeat that ran out
        forgetting.start()
        camera = opened()
        assert camera.grab().lost_packets == 0
        forgetting.join()
        camera.close()
        held.close()


def test_a_camera_that_answers_slowly_is_waited_for():
    with fake(delay_ack={EXPOSURE_TIME: 0.4}) as device:
        camera = opened()
        used_s = camera.set_exposure(0.0123)
        stored = np.frombuffer(device.peek(EXPOSURE_TIME, 8), ">f8")[0]
        camera.close()
    assert used_s == pytest.approx(0.0123, rel=1e-6)
    assert stored * 1e-6 == pytest.approx(used_s, rel=1e-6)


def test_exposures_beyond_the_cameras_bounds_are_brought_within_them():
    with fake():
        camera = opened(max_exposure_s=5.0)
        facts = camera.describe()
        assert camera.set_exposure(100.0) == pytest.approx(facts.exposure_max_s) == pytest.approx(1.0)
        assert camera.set_exposure(1e-9) == pytest.approx(facts.exposure_min_s) == pytest.approx(10e-6)
        camera.close()


def test_the_cameras_temperature_is_read():
    with fake():
        camera = opened()
        found = {finding.title: finding for finding in camera.inspect()}
        camera.close()
    assert found["camera temperature"].measured == pytest.approx(41, abs=5)  # the fake's wanders by a degree or two
    assert found["camera temperature"].ok is True and found["camera temperature"].unit == "deg C"


def test_a_frame_that_nobody_triggered_is_refused():
    with fake() as device:
        camera = opened()
        camera._camera.disable_trigger("FrameStart")  # as by another program's hand
        deadline = time.monotonic() + 5
        while device.blocks_sent() < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
        with pytest.raises(DeviceError) as caught:
            camera.grab()
        camera.close()
    assert caught.value.code == "camera-untriggered"


def test_a_usb3_camera_goes_the_same_way_and_one_without_a_trigger_is_refused():
    table = CameraFile.model_validate({"camera": TABLE | {"width": 64, "height": 48}}).camera
    device = FakeU3vCamera(64, 48, "Mono8")
    camera = device.connect()
    with pytest.raises(RefusedError, match="software trigger"):
        controlled(camera, table, "bench-a.toml")
    assert camera.closed and not device.acquiring()


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono12Packed"])
def test_frames_over_usb3_are_read_by_the_same_code(pixel_format):
    table = GenicamTable(width=64, height=48, field_deg=25.0, pixel_format=pixel_format)
    device = FakeU3vCamera(64, 48, pixel_format)
    with device.connect() as connected, connected.stream(deliver_incomplete=True) as stream:
        frame = stream.next_frame(2000)
        assert frame is not None and frame.is_complete
        counts = GenicamCamera(table, None, connected, stream, None)._counts(frame, 0)  # type: ignore[arg-type]
        payload = frame.payload()
    packed = next(form for form in FORMATS if form.name == pixel_format).packed  # our own reading of the format
    assert counts.shape == (48, 64) and counts.dtype == np.uint16 and np.ptp(counts) > 0
    assert packed(counts) == payload
