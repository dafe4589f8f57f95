"""``holocal compare``: numbers with their errors, significance, and every field that differs."""

from __future__ import annotations

from pathlib import Path

import pytest

from holocal.app import session
from holocal.app.comparing import Pair
from holocal.records.results import Number, main_number, numbers_of


@pytest.fixture(autouse=True)
def no_drawing(monkeypatch):
    monkeypatch.setattr(session, "render_report", lambda directory: b"<!doctype html>")


RUN = ("run", "levelling", "--rig", "lab-bench", "--json")


@pytest.mark.parametrize(
    ("one", "other", "sigmas", "significant"),
    [
        (Number(1.0, 0.3), Number(2.0, 0.4), 2.0, False),
        (Number(1.0, 0.03), Number(0.8, 0.04), -4.0, True),
        (Number(1.0, None), Number(2.0, 0.4), None, None),
        (Number(1.0, None), Number(1.0, None), None, False),
        (Number(1.0, 0.0), Number(2.0, 0.0), None, None),
        (Number(1.0, 0.1), None, None, None),
    ],
)
def test_a_difference_is_significant_beyond_three_standard_errors(one, other, sigmas, significant):
    pair = Pair("after", "rms", one, other)
    assert pair.sigmas == (None if sigmas is None else pytest.approx(sigmas))
    assert pair.significant is significant


def test_numbers_of_nested_tables_take_the_sigmas_and_targets_of_their_joined_keys():
    result = {
        "after": {"median": {"rms_rad": 0.1}, "zones": [1], "tilt_deg": {"mean": 2.0, "sigma": 0.5}, "ok": True},
        "sigma": {"after": {"median_rms_rad": 0.01}},
        "targets": {"missing": 1.0, "median_rms_rad": 0.2},
    }
    assert numbers_of(result, "after") == {
        "median_rms_rad": Number(0.1, 0.01, 0.2),
        "tilt_deg": Number(2.0, 0.5, None),
    }
    assert main_number(result) == "median_rms_rad"


def test_two_runs_side_by_side_name_every_field_that_differs(holocal):
    one = holocal(*RUN, "--seed", "1").json["run"]
    other = holocal(*RUN, "--seed", "2", "--set", "steps=4", "--set", "camera.serial=CAM-2").json["run"]
    answer = holocal("compare", one, other, "--json")
    assert answer.status == 0, answer.err
    differences = answer.json["differences"]
    assert differences["configuration"]["seed"] == [1, 2]
    assert differences["configuration"]["parameters.steps"] == [3, 4]
    assert differences["identity"]["camera.serial"] == ["CAM-1", "CAM-2"]
    (after,) = (line for line in answer.json["numbers"] if line["side"] == "after")
    assert after["difference"] == after["runs"][1]["value"] - after["runs"][0]["value"]
    assert after["significant"] is None  # the procedure gives no standard errors
    text = holocal("compare", one, other)
    assert "identity: camera.serial = CAM-1 | CAM-2" in text.out


def test_a_run_against_itself_does_not_differ(holocal):
    run = holocal(*RUN).json["run"]
    answer = holocal("compare", run, run, "--json")
    assert not any(answer.json["differences"].values())
    assert all(line["significant"] is False for line in answer.json["numbers"])
    assert "are the same" in holocal("compare", run, run).out


def test_runs_of_other_procedures_are_refused(holocal, monkeypatch):
    from lab_bench.levelling import Levelling

    one = holocal(*RUN).json["run"]
    monkeypatch.setattr(Levelling, "name", "tuning")
    other = holocal(*RUN).json["run"]
    answer = holocal("compare", one, other, "--json")
    assert answer.status == 2
    assert answer.json["error"]["measured"] == "tuning"


def test_a_damaged_run_is_not_compared(holocal):
    one, other = (Path(holocal(*RUN).json["run"]) for _ in range(2))
    (other / "result.json").write_text("{}")
    answer = holocal("compare", one, other, "--json")
    assert answer.status == 2
    assert answer.json["error"]["code"] == "damaged-run"
