"""``holocal check``: the accepted calibration holds, has drifted, or is refused; each check is kept."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from lab_bench import rig as lab_rig
from lab_bench.levelling import Levelling

from holocal.app import session
from holocal.app.checking import judged
from holocal.errors import RefusedError
from holocal.loop.checking import Rechecked
from holocal.loop.procedure import Remeasured
from holocal.records.calibration import Accepted, in_force, rig_directory
from holocal.records.maps import Maps


@pytest.fixture(autouse=True)
def no_drawing(monkeypatch):
    monkeypatch.setattr(session, "render_report", lambda directory: b"<!doctype html>")


RUN = ("run", "levelling", "--rig", "lab-bench", "--json")
CHECK = ("check", "--rig", "lab-bench", "--json")


@pytest.fixture
def accepted(holocal) -> Path:
    run = Path(holocal(*RUN).json["run"])
    assert holocal("accept", run).status == 0
    return run


def test_a_calibration_that_holds_exits_0_with_number_sigma_and_limit(holocal, accepted):
    answer = holocal(*CHECK)
    assert answer.status == 0, answer.err
    assert answer.json["verdict"] == "holds"
    (one,) = answer.json["checked"]
    assert (one["procedure"], one["entry"], one["frames"]) == ("levelling", accepted.name, 1)
    number = one["numbers"]["spread"]
    assert number["value"] < number["limit"] == 0.5
    assert number["sigma"] == 0.02
    assert in_force("lab-bench") == {"levelling": accepted.name}


def test_a_bench_that_drifted_exits_3_and_says_what_to_measure_again(holocal, accepted, monkeypatch):
    monkeypatch.setattr(lab_rig, "COUNTS_PER_SECOND", 0.3 * lab_rig.COUNTS_PER_SECOND)
    answer = holocal(*CHECK)
    assert answer.status == 3
    assert answer.json["verdict"] == "drifted"
    assert 0.6 < answer.json["checked"][0]["numbers"]["spread"]["value"] < 0.8
    assert "measure levelling again" in answer.err


def test_frames_that_do_not_show_the_calibration_are_a_drift_with_its_reason(holocal, accepted, monkeypatch):
    def remeasure(self, facts, calibration, parameters, reference, seed):
        yield self._shot(self.start(facts, calibration, parameters, seed), "check", 2000)
        raise RefusedError("the picture is mirrored.")

    monkeypatch.setattr(Levelling, "remeasure", remeasure)
    answer = holocal(*CHECK)
    assert answer.status == 3
    assert "mirrored" in answer.json["checked"][0]["sentence"]


def test_the_checks_are_part_of_the_history(holocal, accepted, monkeypatch, workplace):
    holocal(*CHECK)
    monkeypatch.setattr(lab_rig, "COUNTS_PER_SECOND", 0.3 * lab_rig.COUNTS_PER_SECOND)
    holocal(*CHECK, "--seed", "2")
    (rig_directory("lab-bench") / "checks" / "20260101T000000Z-check-torn.json").write_text('{"checked": [')
    answer = holocal("history", "--rig", "lab-bench", "--plot", "drift.png", "--json")
    assert answer.status == 0, answer.err
    assert sorted(check["verdict"] for check in answer.json["checks"]) == ["drifted", "holds"]
    text = holocal("history", "--rig", "lab-bench").out
    assert text.count(f"check of {accepted.name}") == 2


def test_a_rig_without_a_calibration_is_refused(holocal):
    answer = holocal(*CHECK)
    assert answer.status == 4
    assert answer.json["error"]["code"] == "no-calibration"
    assert "holocal run" in answer.json["error"]["fix"]


def test_a_procedure_that_was_never_accepted_is_refused(holocal, accepted):
    answer = holocal(*CHECK, "--procedure", "uniformity")
    assert answer.status == 4
    assert "uniformity" in answer.json["error"]["what"]


def test_another_rigs_calibration_is_refused_before_the_light_goes_on(holocal, accepted, workplace):
    other = ("--set", "camera.serial=CAM-2", "--set", f"faults.diary={workplace / 'diary'}")
    answer = holocal(*CHECK, *other)
    assert answer.status == 4
    assert (answer.json["error"]["measured"], answer.json["error"]["limit"]) == ("CAM-1", "CAM-2")
    assert "on" not in (workplace / "diary").read_text().split()


def test_a_stale_calibration_is_refused_before_the_light_goes_on(holocal, accepted, workplace):
    directory = rig_directory("lab-bench")
    old = "20200101T000000Z-levelling-aaaa"
    (directory / "entries" / accepted.name).rename(directory / "entries" / old)
    state = next((directory / "states").glob("*.json"))
    state.write_text(json.dumps({**json.loads(state.read_text()), "accepted": {"levelling": old}}))
    rig = workplace / "lab-bench.toml"
    rig.write_text((Path(lab_rig.__file__).parent / "lab-bench.toml").read_text() + "[safety]\n")
    aged = ("--set", "safety.max_calibration_age_days=90", "--set", f"faults.diary={workplace / 'diary'}")
    answer = holocal("check", "--rig", rig, *aged, "--json")
    assert answer.status == 4, answer.err
    assert answer.json["error"]["code"] == "P14"
    assert "on" not in (workplace / "diary").read_text().split()


def test_what_has_no_quick_check_is_refused_when_it_is_all_there_is(holocal, accepted, monkeypatch):
    monkeypatch.setattr("holocal.app.checking.plugins.procedure", lambda name: object())
    answer = holocal(*CHECK)
    assert answer.status == 4
    assert answer.json["error"]["code"] == "not-checkable"


def test_a_lost_camera_exits_6_and_keeps_no_check(holocal, accepted):
    answer = holocal(*CHECK, "--set", "faults.kind=unplugged", "--set", "faults.at=14")
    assert answer.status == 6
    assert not (rig_directory("lab-bench") / "checks").exists()


@pytest.mark.parametrize(
    ("value", "sigma", "verdict", "said"),
    [
        (0.015, 0.001, "holds", "0.015"),
        (0.0215, 0.001, "holds", "limit 0.02"),  # 1.5 standard errors beyond
        (0.0225, 0.001, "drifted", "beyond"),
        (0.9, 0.3, "drifted", "beyond"),
        (0.01, 0.03, "drifted", "cannot be told"),
    ],
)
def test_a_number_has_drifted_beyond_two_standard_errors_of_its_limit(value, sigma, verdict, said):
    result = {"after": {"rms": 0.01}, "targets": {"rms": 0.02}}
    accepted = Accepted("uniformity", "entry", "", result, Maps({}))
    found = judged(accepted, Rechecked(Remeasured({"rms": value}, {"rms": sigma}), "", 3, 1.0))
    assert found.verdict == verdict
    assert said in found.sentence
