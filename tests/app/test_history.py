"""``holocal history`` and its index: the directories are the truth, whatever became of the index."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path

import cv2
import pytest

from holocal.app import session
from holocal.records import index
from holocal.records.calibration import rig_directory
from holocal.records.run_files import RunSummary, summary_of


@pytest.fixture(autouse=True)
def no_drawing(monkeypatch):
    monkeypatch.setattr(session, "render_report", lambda directory: b"<!doctype html>")


RUN = ("run", "levelling", "--rig", "lab-bench", "--json")
HISTORY = ("history", "--rig", "lab-bench", "--json")


def written(runs: Path, name: str, **result: object) -> Path:
    """Return a run directory of the least that a run has, as a finished run leaves it."""
    run = runs / name
    run.mkdir(parents=True)
    (run / "identity.json").write_text(json.dumps({"rig": "bench", "simulated": True}))
    (run / "result.json").write_text(json.dumps({"procedure": name.split("-")[1], "rig": "bench", **result}))
    (run / "manifest.json").write_text(json.dumps({"schema": 1, "status": "complete", "files": {}}))
    return run


def names(runs: list[RunSummary]) -> list[str]:
    return [run.name for run in runs]


@pytest.fixture
def two(workplace) -> Path:
    runs = workplace / "runs"
    numbers = {"before": {"rms": 0.2}, "after": {"rms": 0.01}, "targets": {"rms": 0.02}, "targets_met": True}
    written(runs, "20260101T000000Z-uniformity-aaaa", **numbers)
    written(runs, "20260102T000000Z-uniformity-bbbb", **numbers)
    index.remember(runs)
    return runs


def test_history_lists_runs_in_time_with_verdict_numbers_and_what_is_in_force(holocal):
    first, second = (Path(holocal(*RUN, "--seed", seed).json["run"]) for seed in "12")
    missed = Path(holocal(*RUN, "--set", "target=1e-9").json["run"])
    holocal("accept", first)
    holocal("accept", second)
    lines = {Path(line["run"]).name: line for line in holocal(*HISTORY).json["runs"]}
    assert list(lines) == sorted(lines, key=lambda name: (name[:16], name))
    assert [lines[run.name]["accepted"] for run in (first, second, missed)] == ["before", "in force", None]
    assert [lines[run.name]["verdict"] for run in (first, second, missed)] == ["met", "met", "not met"]
    result = json.loads((second / "result.json").read_text())
    assert lines[second.name]["after"]["spread"] == {"value": result["after"]["spread"], "sigma": None}
    text = holocal("history", "--rig", "lab-bench")
    assert f"in force for lab-bench: levelling = {second.name}" in text.out
    assert [line[0] for line in text.out.splitlines()[1:]] == [
        {"in force": "*", "before": "+", None: " "}[lines[name]["accepted"]] for name in lines
    ]


def test_a_run_is_found_from_another_directory_by_the_end_of_its_name(holocal, workplace, monkeypatch):
    run = Path(holocal(*RUN).json["run"])
    (workplace / "elsewhere").mkdir()
    monkeypatch.chdir(workplace / "elsewhere")
    assert Path(holocal("show", run.name[-4:], "--json").json["run"]) == run
    assert len(holocal(*HISTORY).json["runs"]) == 1


def test_an_accepted_run_stays_in_the_history_when_its_directory_is_gone(holocal):
    run = Path(holocal(*RUN).json["run"])
    holocal("accept", run)
    shutil.rmtree(run)
    (line,) = holocal(*HISTORY).json["runs"]
    assert (line["accepted"], line["verdict"]) == ("in force", "met")
    assert "entries" in line["run"]


def test_another_rigs_runs_are_not_listed_and_the_rigs_that_have_some_are_named(holocal):
    holocal(*RUN)
    answer = holocal("history", "--rig", "simulated")
    assert answer.status == 0
    assert "lab-bench" in answer.err
    assert "no runs are known" in answer.out


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


def _scramble(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[100:3000] = b"\xff" * 2900
    path.write_bytes(bytes(data))


def _other_schema(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()


def _other_rows(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE run SET result = '{'")
    connection.close()


def _a_directory(path: Path) -> None:
    path.unlink()
    (path / "x").mkdir(parents=True)


DAMAGE = [Path.unlink, _truncate, _scramble, _other_schema, _other_rows, _a_directory]


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda one: one.__name__)
def test_a_missing_or_damaged_index_is_made_anew_from_the_directories(two, damage):
    with index.opened() as known:
        before = known.runs("bench")
    assert names(before) == ["20260101T000000Z-uniformity-aaaa", "20260102T000000Z-uniformity-bbbb"]
    damage(index.home() / index.NAME)
    with index.opened() as known:
        assert known.runs("bench") == before


def test_the_index_follows_runs_that_come_change_and_go(two):
    with index.opened() as known:
        assert len(known.runs("bench")) == 2
    run = written(two, "20260103T000000Z-aberration-cccc", targets_met=False)
    with index.opened() as known:
        assert names(known.runs("bench", "aberration")) == [run.name]
    (run / "result.json").write_text(json.dumps({"procedure": "aberration", "rig": "bench", "targets_met": True}))
    with index.opened() as known:
        assert known.runs("bench", "aberration")[0].verdict == "met"
    shutil.rmtree(run)
    with index.opened() as known:
        assert known.runs("bench", "aberration") == []


def test_only_runs_that_changed_are_read_again(two, monkeypatch):
    with index.opened():
        pass
    read: list[str] = []
    monkeypatch.setattr(index, "summary_of", lambda run, **more: read.append(run.name) or summary_of(run, **more))
    with index.opened():
        assert read == []


def test_a_home_that_cannot_be_written_still_gives_the_history(two, monkeypatch):
    def refused(*arguments: object, **options: object) -> sqlite3.Connection:
        if arguments[0] != ":memory:":
            raise sqlite3.OperationalError("unable to open database file")
        return connect(":memory:")

    connect = sqlite3.connect
    monkeypatch.setattr(index.sqlite3, "connect", refused)
    with index.opened() as known:
        assert len(known.runs("bench")) == 2


HARMFUL = {
    "truncated result": ("result.json", '{"procedure": "unif'),
    "a list": ("result.json", "[1, 2]"),
    "endless brackets": ("result.json", "[" * 100_000),
    "numbers that are texts": ("result.json", '{"after": {"rms": "x"}, "targets": 3, "targets_met": true}'),
    "a number beyond all": ("result.json", '{"after": {"rms": 1' + "0" * 400 + '}, "targets": {"rms": 1}}'),
    "half a surrogate": ("identity.json", '{"rig": "bench\\ud800"}'),
    "a control character": ("identity.json", '{"rig": "bench\\u001b[2J"}'),
    "not UTF-8": ("config.toml", b"\xff\xfe"),
    "a manifest of nothing": ("manifest.json", ""),
}


@pytest.mark.parametrize("kind", HARMFUL)
def test_a_damaged_run_harms_neither_the_others_nor_the_terminal(holocal, two, kind):
    name, text = HARMFUL[kind]
    path = two / "20260102T000000Z-uniformity-bbbb" / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    for rig in ("bench", "bench?"):
        answer = holocal("history", "--rig", rig, "--json")
        assert answer.status == 0, answer.err
    plain = holocal("history", "--rig", "bench")
    assert plain.status == 0 and "20260101T000000Z-uniformity-aaaa" in plain.out
    assert "\x1b" not in plain.out and "Traceback" not in plain.err


def test_links_out_of_the_directory_are_not_followed(two, tmp_path):
    secret = written(tmp_path / "secret", "20260109T000000Z-uniformity-zzzz", sentence="secret")
    (two / "20260109T000000Z-uniformity-zzzz").symlink_to(secret)
    run = two / "20260101T000000Z-uniformity-aaaa"
    (run / "result.json").unlink()
    (run / "result.json").symlink_to(secret / "result.json")
    with index.opened() as known:
        found = known.runs("bench")
    assert names(found) == ["20260101T000000Z-uniformity-aaaa", "20260102T000000Z-uniformity-bbbb"]
    assert all(one.result.get("sentence") != "secret" for one in found)


@pytest.mark.parametrize("entry", ["../../../secret", "", "..", "a/b", 3])
def test_a_calibration_whose_state_leads_elsewhere_is_refused_by_name(holocal, entry):
    run = Path(holocal(*RUN).json["run"])
    holocal("accept", run)
    state = next((rig_directory("lab-bench") / "states").glob("*.json"))
    state.write_text(json.dumps({**json.loads(state.read_text()), "accepted": {"levelling": entry}}))
    for command in (HISTORY, RUN):
        answer = holocal(*command)
        assert answer.status == 2
        assert answer.json["error"]["code"] == "damaged-calibration"


def test_the_plot_is_a_picture_and_refuses_other_names(holocal, workplace, two):
    answer = holocal("history", "--rig", "bench", "--plot", "drift.png", "--json")
    assert answer.status == 0, answer.err
    picture = cv2.imread(str(workplace / "drift.png"))
    assert picture is not None and min(picture.shape[:2]) > 200
    assert holocal("history", "--rig", "bench", "--plot", "drift.pdf", "--json").status == 2
    assert holocal("history", "--rig", "nothing", "--plot", "no.png", "--json").status == 2
    assert not (workplace / "no.png").exists()
