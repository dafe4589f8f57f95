"""``holocal accept``: what may become a calibration, and the way back."""

from __future__ import annotations

from pathlib import Path

import pytest

from holocal.app import session
from holocal.records.calibration import in_force


@pytest.fixture(autouse=True)
def no_drawing(monkeypatch):
    """These tests run a dozen runs whose reports nobody reads; the report has tests of its own."""
    monkeypatch.setattr(session, "render_report", lambda directory: b"<!doctype html>")


RUN = ("run", "levelling", "--rig", "lab-bench", "--json")


def test_accept_puts_a_run_in_force_and_rollback_restores_the_one_before(holocal):
    first, second = (Path(holocal(*RUN).json["run"]) for _ in range(2))
    assert holocal("accept", first).status == 0
    assert in_force("lab-bench") == {"levelling": first.name}
    assert holocal("accept", second).status == 0
    assert in_force("lab-bench") == {"levelling": second.name}
    back = holocal("accept", "--rollback", "--rig", "lab-bench", "--json")
    assert back.json["accepted"] == {"levelling": first.name}
    assert holocal("accept", "--rollback", "--rig", "lab-bench").status == 0
    assert in_force("lab-bench") == {}
    assert holocal("accept", "--rollback", "--rig", "lab-bench").status == 4


def test_the_next_run_is_told_what_is_in_force(holocal):
    run = Path(holocal(*RUN).json["run"])
    assert holocal(*RUN).json["corrections"] == {}
    holocal("accept", run)
    assert holocal(*RUN).json["corrections"] == {"levelling": run.name}
    assert holocal(*RUN, "--corrections", "none").json["corrections"] == {}


def test_another_rigs_result_is_refused_naming_the_field_and_both_values(holocal):
    run = holocal(*RUN).json["run"]
    other = ("--rig", "lab-bench", "--set", "camera.serial=CAM-2")
    answer = holocal("accept", run, *other, "--json")
    assert answer.status == 4
    error = answer.json["error"]
    assert "camera.serial" in error["what"] and "CAM-1" in error["what"] and "CAM-2" in error["what"]
    assert (error["measured"], error["limit"]) == ("CAM-1", "CAM-2")
    assert in_force("lab-bench") == {}


def test_a_simulated_result_is_refused_for_a_real_rig(holocal):
    run = holocal(*RUN).json["run"]
    answer = holocal("accept", run, "--rig", "lab-bench", "--set", "faults.simulated=false", "--json")
    assert answer.status == 4
    assert "simulated" in answer.json["error"]["what"]


def test_an_accepted_calibration_of_a_changed_rig_is_refused_until_it_is_measured_again(holocal):
    holocal("accept", holocal(*RUN).json["run"])
    changed = (*RUN, "--set", "camera.serial=CAM-2")
    answer = holocal(*changed)
    assert answer.status == 4
    assert "--corrections none" in answer.json["error"]["fix"]
    again = holocal(*changed, "--corrections", "none")
    assert again.status == 0
    assert holocal("accept", again.json["run"]).status == 0
    assert holocal(*changed).status == 0


def test_a_run_that_did_not_finish_is_refused(holocal, workplace):
    holocal(*RUN, "--set", "rig.faults.kind=unplugged")
    (run,) = (workplace / "runs").iterdir()
    answer = holocal("accept", run, "--json")
    assert answer.status == 4
    assert answer.json["error"]["code"] == "not-complete"


def test_a_run_whose_files_were_changed_is_refused(holocal):
    run = Path(holocal(*RUN).json["run"])
    with (run / "result.json").open("a") as file:
        file.write(" ")
    assert holocal("accept", run).status == 2
    assert in_force("lab-bench") == {}
