"""A recorded run gives the same frames again, bit by bit, and says so when something else is asked of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from lab_bench.levelling import Levelling, Parameters
from lab_bench.rig import LabRig
from recording import WatchedRig

from holocal.errors import ConfigError, DeviceError, HolocalError, InputError, Interrupted
from holocal.loop.devices import Camera, Frame, Light, Slm
from holocal.loop.record import RunRecord
from holocal.loop.runner import RunResult, run
from holocal.records.facts import RigFacts
from holocal.records.frames import write_counts
from holocal.records.rig import identity, load_rig
from rigs.context import DriverContext
from rigs.replay import ReplayCamera, open_camera, open_light, open_slm


class Watcher:
    """An observer that may pull the plug after a step."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.stop_at = stop_at
        self.incidents: list[str] = []

    def preflight(self, checks: Any, seconds: float) -> None: ...

    def waiting(self, what: str) -> None: ...

    def incident(self, sentence: str) -> None:
        self.incidents.append(sentence)

    def step(self, number: int, progress: Any, judgement: Any) -> None:
        if number == self.stop_at:
            raise KeyboardInterrupt


class ReplayRig:
    """A bench of the three replaying drivers, as a rig's file puts it together; it keeps what the loop was given."""

    def __init__(self, directory: Path, facts: RigFacts, patterns: str = "same") -> None:
        context = DriverContext("replay", str(directory.parent / "replay.toml"), facts.wavelengths_m)
        self.slm = open_slm({"driver": "replay", "run": directory.name, "patterns": patterns}, context)
        self.light = open_light({"driver": "replay"}, context)
        self.recorded = open_camera({"driver": "replay", "run": directory.name}, context)
        self.camera: Camera = self
        self._facts = replace(facts, slm=self.slm.describe(), camera=self.recorded.describe())
        self.given: list[Frame] = []

    def facts(self) -> RigFacts:
        return self._facts

    def truth(self) -> None:
        return None

    def describe(self) -> Any:
        return self.recorded.describe()

    def set_exposure(self, exposure_s: float) -> float:
        return self.recorded.set_exposure(exposure_s)

    def grab(self) -> Frame:
        self.given.append(self.recorded.grab())
        return self.given[-1]

    def close(self) -> None: ...


def loop(rig: Any, record: RunRecord, watcher: Watcher, **parameters: Any) -> RunResult | HolocalError:
    with record.open():
        try:
            return run(
                Levelling(),
                rig,
                Parameters(**parameters),
                seed=1,
                record=record,
                calibration={},
                observer=watcher,
                keep_frames=isinstance(rig, WatchedRig),
            )
        except HolocalError as error:
            return error


def recorded(tmp_path: Path, *faults: str, **parameters: Any) -> tuple[WatchedRig, Any, Watcher]:
    lab = LabRig(load_rig("lab-bench", [f"faults.{fault}" for fault in faults]))
    record = RunRecord.create(tmp_path, "levelling", config="", identity=identity(lab.facts()))
    rig, watcher = WatchedRig(lab, record), Watcher()
    return rig, loop(rig, record, watcher, **parameters), watcher


def replayed(tmp_path: Path, rig: WatchedRig, **parameters: Any) -> tuple[ReplayRig, Any, Watcher]:
    again, watcher = ReplayRig(rig.record.directory, rig.facts()), Watcher()
    record = RunRecord.create(tmp_path, "again", config="", identity={})
    return again, loop(again, record, watcher, **parameters), watcher


def same_frames(first: list[Frame], second: list[Frame]) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(a.counts, b.counts)
        and (a.exposure_s, a.frame_id, a.lost_packets, a.saturated_fraction)
        == (b.exposure_s, b.frame_id, b.lost_packets, b.saturated_fraction)
        for a, b in zip(first, second, strict=True)
    )


@pytest.mark.parametrize(
    ("faults", "exposure_s", "incidents"),
    [
        ((), 0.02, 0),
        (("kind=frozen-once", "at=15"), 0.02, 1),
        (("kind=lost-once", "at=15"), 0.02, 1),
        ((), 0.05, 4),  # 5000 counts against a full scale of 4095: halved once in each step and the verification
    ],
)
def test_a_whole_run_replays_to_the_same_frames_and_the_same_result(
    tmp_path: Path, faults: tuple[str, ...], exposure_s: float, incidents: int
) -> None:
    rig, done, watched = recorded(tmp_path, *faults, exposure_s=exposure_s)
    again, done_again, watched_again = replayed(tmp_path, rig, exposure_s=exposure_s)
    assert isinstance(done, RunResult)
    assert isinstance(done_again, RunResult)
    assert same_frames(rig.taken, again.given)
    assert len(rig.taken) > 7  # the pre-flight and a retake too
    assert watched_again.incidents == watched.incidents
    assert len(watched.incidents) == incidents
    for key in ("before", "after", "steps", "frames", "sentence"):
        assert done_again.result[key] == done.result[key]


def test_a_run_that_was_interrupted_and_resumed_replays_as_one(tmp_path: Path) -> None:
    lab = LabRig(load_rig("lab-bench"))
    record = RunRecord.create(tmp_path, "levelling", config="", identity=identity(lab.facts()))
    rig = WatchedRig(lab, record)
    assert isinstance(loop(rig, record, Watcher(stop_at=2)), Interrupted)
    second = WatchedRig(LabRig(load_rig("lab-bench")), RunRecord.reopen(record.directory))
    done = loop(second, second.record, Watcher())
    assert isinstance(done, RunResult)
    again, done_again, _ = replayed(tmp_path, rig)
    assert isinstance(done_again, RunResult)
    assert done_again.result["after"] == done.result["after"]
    numbers = [frame.frame_id for frame in again.given]
    assert numbers == sorted(set(numbers))  # the second camera began at 1 again


def test_another_exposure_than_the_recorded_one_is_another_run(tmp_path: Path) -> None:
    rig, _, _ = recorded(tmp_path)
    _, error, _ = replayed(tmp_path, rig, exposure_s=0.0201)
    assert isinstance(error, RunResult)  # half a percent may be a camera's rounding; 5 % is not
    _, error, _ = replayed(tmp_path, rig, exposure_s=0.021)
    assert isinstance(error, DeviceError)
    assert error.code == "replay-exposure"
    # The first frame is the pre-flight's, at the geometric mean of the shortest and the procedure's exposure.
    assert error.measured / error.limit == pytest.approx(1.05**0.5)


def test_another_pattern_than_the_recorded_one_is_named_unless_any_is_allowed(tmp_path: Path) -> None:
    rig, _, _ = recorded(tmp_path)
    levels = np.zeros((rig.facts().slm.height, rig.facts().slm.width), np.uint8)
    levels[3, 5] = 1
    strict = ReplayRig(rig.record.directory, rig.facts()).slm
    with pytest.raises(DeviceError, match=r"pattern 1 is another"):
        strict.show(levels)
    assert ReplayRig(rig.record.directory, rig.facts(), patterns="any").slm.show(levels).read_back_ok is None


def test_beyond_the_last_frame_the_record_says_how_many_there_are(tmp_path: Path) -> None:
    rig, _, _ = recorded(tmp_path)
    camera = ReplayRig(rig.record.directory, rig.facts()).recorded
    for frame in rig.taken:
        assert np.array_equal(camera.grab().counts, frame.counts)
    with pytest.raises(DeviceError, match=f"has {len(rig.taken)} frames; frame {len(rig.taken) + 1} was asked for"):
        camera.grab()


def test_a_run_that_kept_only_some_frames_gives_these_and_names_the_first_that_is_missing(tmp_path: Path) -> None:
    lab = LabRig(load_rig("lab-bench"))
    record = RunRecord.create(tmp_path, "levelling", config="", identity=identity(lab.facts()))
    assert isinstance(loop(lab, record, Watcher(), steps=1), RunResult)  # keeps its verification's frame alone
    camera = ReplayRig(record.directory, lab.facts()).recorded
    with pytest.raises(DeviceError, match=r"frame 1 of 2 of the run \(square\) was not kept"):
        camera.grab()


def test_what_is_no_record_is_refused(tmp_path: Path) -> None:
    context = DriverContext("replay", str(tmp_path / "rig.toml"), ())
    with pytest.raises(InputError, match=r"nowhere is not a run directory"):
        open_camera({"run": "nowhere"}, context)
    rig, _, _ = recorded(tmp_path)
    journal = rig.record.directory / "events.jsonl"
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    outside = [{**line, "file": "../secret.png"} if line["event"] == "grab" else line for line in lines]
    journal.write_text("\n".join(json.dumps(line) for line in outside))
    with pytest.raises(InputError, match="lies outside of the run"):
        open_camera({"run": rig.record.directory.name}, context)
    journal.write_text("")
    with pytest.raises(InputError, match="names no frames"):
        open_camera({"run": rig.record.directory.name}, context)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({}, "either run or frames"),
        ({"run": "a", "frames": "b"}, "either run or frames"),
        ({"run": "a", "bits": 12}, "a run says bits itself"),
        ({"run": "a", "k1": 0.01, "rotation_deg": 1.0}, "a run says rotation_deg, k1 itself"),
        ({"frames": "a", "bits": 12}, "frames do not say field_deg, exposure_s"),
        ({"frame": "a"}, r"unknown key frame\. Did you mean frames\?"),
    ],
)
def test_a_wrong_table_is_refused_by_name(table: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        open_camera(table, DriverContext("replay", "rig.toml", ()))


def pictures(count: int) -> list[np.ndarray[Any, Any]]:
    return [np.random.default_rng(seed).integers(0, 4096, (48, 64), np.uint16) for seed in range(count)]


def camera_of(folder: Path, frames: str, **keys: Any) -> ReplayCamera:
    table = {"frames": frames, "bits": 12, "field_deg": 25.0, "exposure_s": 0.01, **keys}
    return open_camera(table, DriverContext("replay", str(folder / "rig.toml"), ()))


@pytest.mark.parametrize("frames", ["pictures", "pictures/*.png"])
def test_pictures_of_any_origin_come_in_the_order_of_their_names(tmp_path: Path, frames: str) -> None:
    (tmp_path / "pictures").mkdir()
    sent = pictures(12)
    for number, counts in reversed(list(enumerate(sent))):
        write_counts(tmp_path / "pictures" / f"{number:03d}.png", counts)
    (tmp_path / "pictures" / "notes.txt").write_text("not a frame")
    camera = camera_of(tmp_path, frames, rotation_deg=2.0, k1=0.01, k2=-0.02)
    facts = camera.describe()
    assert (facts.rotation_rad, facts.k1, facts.k2) == (pytest.approx(np.deg2rad(2.0)), 0.01, -0.02)
    assert (facts.width, facts.height, facts.full_scale) == (64, 48, 4095)
    # Square pixels: the tangents of half the field are as 64 to 48.
    assert np.tan(facts.field_rad[1] / 2) == pytest.approx(np.tan(facts.field_rad[0] / 2) * 48 / 64)
    assert camera.set_exposure(0.01005) == 0.01  # what was used then, not what is asked for now
    got = [camera.grab() for _ in range(12)]
    assert all(np.array_equal(frame.counts, counts) for frame, counts in zip(got, sent, strict=True))
    assert [frame.frame_id for frame in got] == list(range(12))
    with pytest.raises(DeviceError, match="has 12 frames"):
        camera.grab()


def test_a_lossless_video_comes_back_count_by_count_and_a_lossy_one_is_refused(tmp_path: Path) -> None:
    sent = [(counts >> 4).astype(np.uint8) for counts in pictures(4)]
    for name, codec in (("exact.avi", "FFV1"), ("lossy.avi", "MJPG")):
        video = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*codec), 10, (64, 48), isColor=False)
        assert video.isOpened()
        for counts in sent:
            video.write(counts)
        video.release()
    camera = camera_of(tmp_path, "exact.avi", bits=8)
    assert all(np.array_equal(camera.grab().counts, counts) for counts in sent)
    with pytest.raises(InputError, match="MJPG"):
        camera_of(tmp_path, "lossy.avi", bits=8)


def test_pictures_in_colour_are_not_counts(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((4, 5, 3), np.uint8))
    with pytest.raises(InputError, match="not a grey picture"):
        camera_of(tmp_path, "colour.png")
    with pytest.raises(InputError, match="gives no frames"):
        camera_of(tmp_path, "missing/*.png")


def test_the_replaying_devices_play_the_loops_roles(tmp_path: Path) -> None:
    rig, _, _ = recorded(tmp_path)
    again = ReplayRig(rig.record.directory, rig.facts())
    assert isinstance(again.recorded, Camera)
    assert isinstance(again.slm, Slm)
    assert isinstance(again.light, Light)
    assert again.recorded.describe() == rig.facts().camera
    assert again.slm.describe() == rig.facts().slm
    again.light.select(515e-9)
    with pytest.raises(ConfigError, match="633 nm"):
        again.light.select(633e-9)
