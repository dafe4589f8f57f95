"""``holocal run`` and what follows it, on a lab's own bench: exit statuses, files, JSON."""

from __future__ import annotations

import html
import json
import os
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from holocal.app.session import lock_of
from holocal.loop.lock import locked
from holocal.records.manifest import problems, read_manifest
from holocal.records.maps import read_maps

RUN = ("run", "levelling", "--rig", "lab-bench", "--json")


def faulty(kind: str, **more: object) -> list[str]:
    values = {"kind": kind, **more}
    return [part for key, value in values.items() for part in ("--set", f"rig.faults.{key}={value}")]


def test_a_run_that_meets_its_target_exits_0_with_one_json_object_and_a_whole_record(holocal, workplace):
    answer = holocal(*RUN, "--seed", "4")
    assert answer.status == 0, answer.err
    result = answer.json
    directory = Path(result["run"])
    assert result["schema"] == 1 and result["procedure"] == "levelling" and result["rig"] == "lab-bench"
    assert result["targets_met"] is True and result["seed"] == 4
    assert result["frames"] == 4  # three steps and the verification
    assert result["truth"] == {"gain": 1.0}
    assert result["before"].keys() == result["after"].keys()
    assert directory.parent == workplace / "runs"
    names = {path.name for path in directory.iterdir()} - {".lock"}
    assert names == {
        "config.toml", "identity.json", "environment.json", "preflight.json", "events.jsonl", "checkpoint.json",
        "checkpoint-0.npz", "checkpoint-1.npz", "before.exr", "after.exr", "maps.exr", "frames", "figures.npz",
        "result.json", "report.html", "log.txt", "manifest.json",
    }  # fmt: skip
    assert read_manifest(directory)["status"] == "complete"
    assert problems(directory) == []
    assert json.loads((directory / "result.json").read_text()) == result
    assert "levelling" in answer.err and "pre-flight" in answer.err
    assert "\x1b" not in answer.err  # stderr is no terminal: no colours, no spinner


def test_a_run_that_misses_its_target_exits_3_and_cannot_be_accepted(holocal):
    answer = holocal(*RUN, "--set", "target=1e-9")
    assert answer.status == 3
    assert answer.json["targets_met"] is False
    refused = holocal("accept", answer.json["run"], "--json")
    assert refused.status == 4
    assert refused.json["error"]["code"] == "targets-missed"


@pytest.mark.parametrize(
    ("fault", "status", "code"),
    [
        ("unplugged", 6, "device-lost"),
        ("stale", 6, "gate-stale"),
        ("frozen", 6, "gate-identical"),
        ("lost", 6, "gate-lost-packets"),
        ("not-a-number", 6, "gate-misshapen"),
        ("too-bright", 5, "too-bright"),
        ("left-justified", 4, "P07b"),
        ("frozen-panel", 4, "P10"),
        ("read-back", 4, "P05"),
    ],
)
def test_each_fault_ends_with_its_exit_status_a_reason_and_a_report(holocal, workplace, fault, status, code):
    answer = holocal(*RUN, *faulty(fault))
    assert answer.status == status, answer.err
    error = answer.json["error"]
    assert error["code"] == code
    assert error["exit_status"] == status
    assert error["fix"]
    assert "Traceback" not in answer.err
    (directory,) = (workplace / "runs").iterdir()
    manifest = read_manifest(directory)
    assert manifest["status"] == ("interrupted" if status == 6 else "failed")
    assert problems(directory) == []
    assert html.escape(error["what"], quote=False) in (directory / "report.html").read_text().replace("&#39;", "'")


def test_a_disk_without_room_is_refused_before_the_light_goes_on(holocal, monkeypatch):
    from lab_bench.rig import Lamp

    from holocal.loop.preflight import without_light

    def never(lamp: Lamp) -> None:
        raise AssertionError("the light went on")

    monkeypatch.setattr(without_light, "RECORD_BYTES", 2**60)
    monkeypatch.setattr(Lamp, "on", never)
    answer = holocal(*RUN)
    assert answer.status == 4
    assert answer.json["error"]["code"] == "P02"


def test_a_frame_that_is_bad_once_is_taken_again_and_noted(holocal):
    answer = holocal(*RUN, *faulty("lost-once"))
    assert answer.status == 0, answer.err
    assert answer.json["frames"] == 5  # one more than without
    directory = Path(answer.json["run"])
    incidents = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    (incident,) = [line for line in incidents if line["event"] == "incident"]
    assert incident["gate"] == "lost-packets" and incident["measured"] == 3.0
    assert (directory / incident["file"]).is_file()


def test_light_that_clips_is_halved_and_the_run_goes_on(holocal):
    answer = holocal(*RUN, "--set", "exposure_s=0.06")  # three times what half of full scale needs
    assert answer.status == 0, answer.err
    lines = [json.loads(line) for line in (Path(answer.json["run"]) / "events.jsonl").read_text().splitlines()]
    steps = [line for line in lines if line["event"] == "step"]
    assert all(shot["exposure_s"] == pytest.approx(0.03) for step in steps for shot in step["shots"])
    assert {line["gate"] for line in lines if line["event"] == "incident"} == {"clipped"}


def test_a_bug_exits_1_with_one_line_and_its_traceback_in_the_log(holocal, workplace):
    answer = holocal(*RUN, "--set", "bug_at=2")
    assert answer.status == 1
    assert "Traceback" not in answer.err and "ZeroDivisionError" in answer.err
    (directory,) = (workplace / "runs").iterdir()
    assert "Traceback" in (directory / "log.txt").read_text()
    assert read_manifest(directory)["status"] == "failed"


def test_a_dry_run_prints_the_plan_and_touches_nothing(holocal, workplace):
    answer = holocal(*RUN, "--dry-run")
    assert answer.status == 0
    assert answer.json["frames"] == 4 and answer.json["exposure_ceiling_s"] == 0.02
    assert list(workplace.iterdir()) == []


@pytest.mark.parametrize("command", [(*RUN, "--dry-run"), ("render", "points.csv", "--rig", "lab-bench", "--json")])
def test_what_only_asks_a_real_rig_for_its_facts_does_not_disturb_who_works_with_it(holocal, workplace, command):
    (workplace / "points.csv").write_text("theta_x_deg,theta_y_deg,distance_m,intensity\n0,0,inf,1\n")
    with locked(lock_of("lab-bench"), "rig lab-bench"):
        answer = holocal(*command)
    assert answer.status == 75, answer.err


def test_the_same_seed_gives_the_same_maps_and_another_seed_others(holocal):
    runs = [Path(holocal(*RUN, "--seed", seed).json["run"]) for seed in ("1", "1", "2")]
    maps = [(run / "maps.exr").read_bytes() for run in runs]
    first, second = (read_maps(run / "maps.exr").channels["correction.intensity_weight"] for run in runs[:2])
    assert np.array_equal(first, second)
    assert maps[0] != maps[2]


def interrupted(workplace: Path, *, kill: signal.Signals, after_steps: int) -> tuple[Path, int]:
    """Start a slow run in a process of its own, send it a signal after some steps, return its directory and status."""
    lab = Path(__file__).parents[1] / "lab"
    environment = {**os.environ, "PYTHONPATH": str(lab)}
    command = [sys.executable, "-c", "from holocal.app.cli.main import main; main()", *RUN, "--seed", "3"]
    command += ["--set", "steps=6", "--set", "slow_s=0.15"]
    process = subprocess.Popen(command, cwd=workplace, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        journals = list((workplace / "runs").glob("*/events.jsonl"))
        if journals and journals[0].read_text().count('"step"') >= after_steps:
            break
        time.sleep(0.02)
    process.send_signal(kill)
    process.communicate(timeout=30)
    return journals[0].parent, process.returncode


@pytest.mark.parametrize(("kill", "status"), [(signal.SIGKILL, -9), (signal.SIGINT, 130), (signal.SIGTERM, 130)])
def test_a_run_that_was_stopped_resumes_and_ends_as_an_uninterrupted_one(holocal, workplace, kill, status):
    reference = holocal(*RUN, "--seed", "3", "--set", "steps=6").json
    for path in (workplace / "runs").iterdir():
        path.rename(workplace / path.name)
    directory, ended = interrupted(workplace, kill=kill, after_steps=2)
    assert ended == status
    resumed = holocal("resume", str(directory), "--json")
    assert resumed.status == 0, resumed.err
    for key in ("after", "before", "frames", "steps", "targets", "targets_met"):
        assert resumed.json[key] == reference[key]
    kept = read_maps(workplace / Path(reference["run"]).name / "maps.exr").channels
    assert all(np.array_equal(kept[name], now) for name, now in read_maps(directory / "maps.exr").channels.items())
    steps = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    assert [line["step"] for line in steps if line["event"] == "step"] == [1, 2, 3, 4, 5, 6]
    assert problems(directory) == []


def test_a_damaged_checkpoint_is_refused(holocal, workplace):
    assert holocal(*RUN, *faulty("unplugged")).status == 6
    (directory,) = (workplace / "runs").iterdir()
    slot = directory / json.loads((directory / "checkpoint.json").read_text())["file"]
    data = bytearray(slot.read_bytes())
    data[len(data) // 2] ^= 1
    slot.write_bytes(bytes(data))
    answer = holocal("resume", str(directory), "--json")
    assert answer.status == 2
    assert answer.json["error"]["code"] == "damaged-checkpoint"


def test_a_complete_run_is_not_resumed(holocal):
    assert holocal("resume", holocal(*RUN).json["run"]).status == 2


def test_a_rig_that_another_process_uses_exits_75(holocal):
    from holocal.loop.lock import locked
    from holocal.records.calibration import rig_directory

    with locked(rig_directory("lab-bench") / "lock", "rig lab-bench"):
        answer = holocal(*RUN)
    assert answer.status == 75
    assert answer.json["error"]["code"] == "busy"


class Page(HTMLParser):
    """What a report holds."""

    def __init__(self) -> None:
        super().__init__()
        self.pictures: list[dict[str, str | None]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            self.pictures.append(dict(attrs))


def test_the_report_is_self_contained_and_says_the_numbers_of_the_result(holocal):
    answer = holocal(*RUN)
    text = (Path(answer.json["run"]) / "report.html").read_text()
    page = Page()
    page.feed(text)
    assert len(page.pictures) == 6  # five figures and the convergence
    assert all(picture["alt"] for picture in page.pictures)
    assert all((picture["src"] or "").startswith("data:image/png;base64,") for picture in page.pictures)
    assert "http" not in text and "<script" not in text
    assert answer.json["sentence"] in text
    assert f"{answer.json['after']['spread']:.4g}" in text
    assert "holocal run levelling --rig lab-bench --seed 0" in text


def test_show_verify_and_report_read_what_was_done(holocal):
    run = holocal(*RUN).json["run"]
    assert "spread" in holocal("show", run).out
    assert holocal("show", Path(run).name[-4:], "--json").json["status"] == "complete"
    assert holocal("verify", run).status == 0
    out = Path(run).parent / "again.html"
    assert holocal("report", run, "--out", str(out)).status == 0
    assert out.read_bytes() == (Path(run) / "report.html").read_bytes()
    (Path(run) / "maps.exr").write_bytes(b"other")
    damaged = holocal("verify", run, "--json")
    assert damaged.status == 2 and "maps.exr" in damaged.json["error"]["what"]


def test_a_full_disk_ends_the_run_with_its_reason_and_nothing_half_written(holocal, workplace, monkeypatch):
    import errno

    from holocal.records import files

    real = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if path.name.startswith(".checkpoint-"):
            real(path, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(files.Path, "write_bytes", full)
    answer = holocal(*RUN)
    assert answer.status == 2
    assert answer.json["error"]["code"] == "storage-full"
    (directory,) = (workplace / "runs").iterdir()
    assert not list(directory.rglob("*checkpoint*"))
    assert not list(directory.rglob("*.tmp*"))


def test_a_mode_is_the_same_as_setting_it_and_refused_where_a_procedure_has_none(holocal):
    plans = [
        holocal("run", "aberration", "--rig", "simulated-small", "--dry-run", "--json", *how).json
        for how in (["--mode", "sweep"], ["--set", "mode=sweep"], [])
    ]
    assert plans[0] == plans[1]
    assert plans[0]["frames"] == 12
    assert plans[2]["frames"] == 6
    answer = holocal(*RUN, "--mode", "sweep")
    assert answer.status == 2
    assert "mode" in answer.json["error"]["what"]
    wrong = holocal("run", "aberration", "--rig", "simulated-small", "--mode", "guess", "--json")
    assert wrong.status == 2
