"""The procedure `distortion`, whole, through the runner, on the simulated bench with a small panel."""

from __future__ import annotations

import numpy as np
import pytest

from holocal.app.corrections import corrections_of
from holocal.errors import RefusedError
from holocal.estimate.camera_lens import ideal_pixels
from holocal.hologram.scenes.points import PointCloud
from holocal.loop.record import RunRecord
from holocal.loop.runner import run
from holocal.records.calibration import Accepted
from holocal.records.maps import read_maps
from holocal.records.rig import load_rig
from procedures.distortion import Distortion, Parameters
from rigs.simulated.rig import SimulatedRig


class Watcher:
    """Listens to nothing."""

    def preflight(self, checks, seconds): ...

    def waiting(self, what): ...

    def incident(self, sentence): ...

    def step(self, number, progress, judgement): ...


def go(directory, rig=None, **chosen):
    rig = rig or SimulatedRig(load_rig("simulated-small", chosen.pop("tables", {})))
    record = RunRecord.create(directory, "distortion", config="", identity={})
    with record.open():
        done = run(
            Distortion(), rig, Parameters(**chosen), seed=2, record=record, calibration={}, observer=Watcher(),
        )  # fmt: skip
    return done.result, done.directory


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """One run that several tests look at, with a camera that is turned and bends its picture."""
    tables = {"camera.rotation_deg": 3.0, "camera.k1": -0.05}
    return go(tmp_path_factory.mktemp("runs"), tables=tables)


def test_the_picture_is_straight_at_spots_that_the_map_has_not_seen(found):
    result, _ = found
    assert result["frames"] == 6
    assert result["before"]["rms_px"] > 20
    assert result["after"]["rms_px"] < 0.12 and result["after"]["max_px"] < 0.5
    assert result["after"]["points_found"] >= 0.8 * result["after"]["points_expected"]
    assert result["corners_only"]["rms_px"] > 1.5 * result["after"]["rms_px"]  # a small panel's field is small


def test_what_is_corrected_is_the_display_not_the_camera(found):
    """By exact rays, which know nothing of the camera: 3 degrees of rotation would leave 10 px, its k1 0.5."""
    left = found[0]["truth"]["residual_px"]
    assert left["points"] >= 15 and left["rms"] < 0.1 and left["max"] < 0.3


def test_accepted_maps_send_points_where_the_map_says(found):
    result, directory = found
    maps = read_maps(directory / "maps.exr")
    accepted = {"distortion": Accepted("distortion", "entry", "", result, maps)}
    correction = corrections_of(accepted, fov_rad=(np.radians(25.0),) * 2)
    assert correction.shift is not None
    wanted = np.array([[0.02, 0.01], [-0.05, 0.03]])
    cloud = PointCloud(wanted, np.full(2, np.inf), np.ones(2), np.zeros(2))
    sent = correction.apply(cloud, (0.0, 0.0)).field_tan
    # what is sent there is seen where it was wanted: the other channel, read where it was sent
    size = maps.channels["map.seen_tan_x"].shape[0]
    half = np.tan(np.radians(12.5))
    at = ((sent / half * [1, -1] + 1) / 2 * size - 0.5).round().astype(int)
    seen = np.array([[maps.channels[f"map.seen_tan_{a}"][r, c] for a in "xy"] for c, r in at])
    cell = 2 * half / size
    assert np.abs(seen - wanted).max() < 0.8 * cell and np.abs(sent - wanted).max() > 3 * cell
    assert np.nanmin(maps.channels["sigma_px"]) > 0
    corner, middle = maps.channels["sigma_px"][0, 0], maps.channels["sigma_px"][75, 75]
    assert corner > 3 * middle


def test_four_corners_leave_the_edges_bent(tmp_path):
    result, _ = go(tmp_path, mode="corners")
    assert result["frames"] == 4
    assert result["map"]["kind"] == "homography"
    assert result["after"]["rms_px"] > 0.06


def test_a_mirrored_camera_is_refused_by_name(tmp_path):
    rig = SimulatedRig(load_rig("simulated-small", {}))
    grab = rig.camera.grab

    class Mirrored(Distortion):
        def start(self, *given):
            def other_way():
                frame = grab()
                return type(frame)(
                    np.ascontiguousarray(frame.counts[:, ::-1]), frame.exposure_s, frame.frame_id, 0.0, 0
                )

            rig.camera.grab = other_way
            return super().start(*given)

    record = RunRecord.create(tmp_path, "distortion", config="", identity={})
    with record.open(), pytest.raises(RefusedError, match="mirrored left to right"):
        run(Mirrored(), rig, Parameters(), seed=1, record=record, calibration={}, observer=Watcher())


def test_the_ideal_camera_is_that_of_the_spots():
    rig = SimulatedRig(load_rig("simulated-small", {}))
    middle = ideal_pixels(np.zeros((1, 2)), rig.facts().camera)
    assert np.allclose(middle, [[374.5, 374.5]])
