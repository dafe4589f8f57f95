"""Every fault that can be asked for, through the command line, on a tiny simulated rig: what notices it, how it ends.

The manual's table of faults is the table of these tests.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from holocal.records.fault_model import FaultTable
from holocal.records.manifest import problems, read_manifest
from holocal.records.maps import read_maps

# 128 x 72 pixels and a pupil of 1 mm: a frame takes 0.05 s. Speckle of 15 counts (rms) on a noise of 4 at 0.3 s.
RIG = """
kind = "simulated"
[slm]
width = 128
height = 72
fill_factor = 0.93
[optics]
pupil_mm = 1.0
pupil_edge_mm = 0.1
[camera]
width = 96
height = 80
field_deg = 6.0
hot_pixels = 3
"""
RUN = ("run", "levelling", "--rig", "tiny.toml", "--seed", "4", "--set", "exposure_s=0.3", "--json")
PREFLIGHT_FRAMES = 14  # of this rig: 2 dark, 3 to find the exposure, 5 more, 2 blank, 1 of the pattern again, 1 dark
GRAB = PREFLIGHT_FRAMES + 2  # of the run's second step
SHOW = 5  # of the run's second step: the pre-flight shows the random pattern, level 0, and the pattern again


@dataclass(frozen=True)
class Case:
    """A fault, what notices it, and the exit status."""

    sets: str
    notices: str
    status: int


CASES = (
    Case(f"stale_at_grab={GRAB}", "incident stale", 0),
    Case(f"stale_from_grab={GRAB}", "gate-stale", 6),
    Case(f"repeated_from_grab={GRAB}", "gate-identical", 6),
    Case(f"dropped_at_grab={GRAB}", "device-lost", 6),
    Case(f"truncated_at_grab={GRAB}", "incident lost-packets", 0),
    Case(f"short_at_grab={GRAB}", "incident misshapen", 0),
    Case(f"nan_at_grab={GRAB}", "incident misshapen", 0),
    Case(f"lose_camera_from_grab={GRAB}", "device-lost", 6),
    Case(f"lose_slm_from_show={SHOW}", "device-lost", 6),
    Case(f"lose_light_from_grab={GRAB}", "gate-unlit", 6),
    Case(f"saturate_from_grab={GRAB}", "too-bright", 5),
    Case("saturate_from_grab=1 saturate_factor=1e6", "too-bright", 5),
    Case("drift_per_grab=0.01", "P12", 4),
    Case("swapped_camera=true", "P03", 4),
    Case("left_justified=true", "P07b", 4),
    Case(f"ignore_show_at={SHOW}", "incident unchanged", 0),
    Case(f"ignore_shows_from={SHOW}", "gate-unchanged", 6),
    Case(f"ignore_shows_from={SHOW} read_back=none", "gate-unchanged", 6),
    Case(f"ignore_shows_from={SHOW} read_back=honest", "slm-read-back", 6),
    Case("ignore_shows_from=1 read_back=honest", "P05", 4),
    Case("ignore_shows_from=1", "P10", 4),
    Case("output_gamma=1.5", "P04", 4),
    Case("latency_frames=1", "P11a", 4),
    Case("latency_frames=3", "P11a", 4),
)


@pytest.fixture
def tiny(workplace: Path) -> Path:
    (workplace / "tiny.toml").write_text(RIG)
    return workplace


def sets_of(case: Case) -> list[str]:
    """Return the options of a case; a swapped camera is one that the rig's file does not name."""
    found = [part for item in case.sets.split() for part in ("--set", f"faults.{item}")]
    return [*found, "--set", "camera.serial=C0"] if "swapped" in case.sets else found


def events(directory: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The result of a run without faults, and its maps."""
    from holocal.app import session
    from holocal.app.terminal import Terminal
    from holocal.records.rig import load_rig

    place = tmp_path_factory.mktemp("undisturbed")
    (place / "tiny.toml").write_text(RIG)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOLOCAL_HOME", str(place / "home"))
        done = session.start(
            "levelling",
            load_rig(str(place / "tiny.toml")),
            {"exposure_s": 0.3},
            seed=4,
            runs=place / "runs",
            corrections_choice="none",
            observer=Terminal(),
        )
    assert done.result["preflight_frames"] == PREFLIGHT_FRAMES + 1  # and the pattern once more at the end
    assert abs(done.result["source_drift"]) < 0.01  # noise alone
    return {**done.result, "maps": read_maps(done.directory / "maps.exr").channels}


def same_as(result: dict[str, Any], undisturbed: dict[str, Any]) -> bool:
    maps = read_maps(Path(result["run"]) / "maps.exr").channels
    return all(result[key] == undisturbed[key] for key in ("before", "after", "steps", "targets_met")) and all(
        np.array_equal(values, undisturbed["maps"][name]) for name, values in maps.items()
    )


def test_light_that_is_another_at_the_end_of_a_run_has_drifted(holocal, tiny):
    answer = holocal(*RUN, "--set", f"faults.saturate_from_grab={GRAB}", "--set", "faults.saturate_factor=1.3")
    assert answer.status == 3, answer.err
    assert answer.json["targets_met"] is False
    assert answer.json["source_drift"] == pytest.approx(0.3, abs=0.02)  # noise, and the dark level's share
    (directory,) = (tiny / "runs").iterdir()
    assert [line["ok"] for line in events(directory) if line["event"] == "drift"] == [False]
    assert "changed by +" in answer.err


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.sets.replace(" ", "+"))
def test_each_fault_is_noticed_and_nothing_is_lost(holocal, tiny, undisturbed, case):
    answer = holocal(*RUN, *sets_of(case))
    assert answer.status == case.status, answer.err
    assert "Traceback" not in answer.err
    (directory,) = (tiny / "runs").iterdir()
    assert problems(directory) == []
    assert (directory / "report.html").is_file()
    lines = events(directory)
    if case.status == 0:  # one bad frame: taken again, and the run goes on
        (incident,) = [line for line in lines if line["event"] == "incident"]
        assert f"incident {incident['gate']}" == case.notices
        assert (directory / incident["file"]).is_file()
        assert answer.json["frames"] == undisturbed["frames"] + 1
        assert answer.json["before"] == undisturbed["before"] and answer.json["targets_met"]
        return
    error = answer.json["error"]
    assert (error["code"], error["exit_status"]) == (case.notices, case.status)
    assert error["fix"]
    assert lines[-1]["event"] == "error"
    gates = [line for line in lines if line["event"] == "incident"]
    assert bool(gates) == (case.notices.startswith("gate-") or (case.status == 5 and f"{GRAB}" in case.sets))
    assert all((directory / line["file"]).is_file() for line in gates)
    if case.status == 4:
        found = {check["id"]: check for check in json.loads((directory / "preflight.json").read_text())["checks"]}
        assert found[case.notices]["verdict"] == "fail"
        assert found[case.notices]["remedy"]
        assert [line["failed"] for line in lines if line["event"] == "preflight"]
    assert read_manifest(directory)["status"] == ("interrupted" if case.status == 6 else "failed")
    if case.status == 6:  # a drill is over when it is resumed
        resumed = holocal("resume", str(directory), "--json")
        assert resumed.status == 0, resumed.err
        assert same_as(resumed.json, undisturbed)
        (over,) = [line for line in events(directory) if line["event"] == "faults-over"]
        assert f"faults.{next(iter(over['faults']))}" in " ".join(sets_of(case))


def test_light_that_clips_is_halved_three_times_and_no_more(holocal, tiny):
    answer = holocal(*RUN, "--set", f"faults.saturate_from_grab={GRAB}", "--set", "faults.saturate_factor=1000.0")
    assert answer.status == 5
    (directory,) = (tiny / "runs").iterdir()
    incidents = [line for line in events(directory) if line["event"] == "incident"]
    assert [line["gate"] for line in incidents] == ["clipped"] * 4  # at 0.3 s, and after each halving
    assert "3 halvings" in answer.json["error"]["what"] and "37.5 ms" in answer.json["error"]["what"]


def test_a_fault_of_the_panel_in_the_middle_of_a_loss_leaves_the_light_off(holocal, tiny, monkeypatch):
    from rigs.simulated.rig import SimulatedLight

    said = []
    monkeypatch.setattr(SimulatedLight, "off", lambda light: said.append("off"))
    assert holocal(*RUN, "--set", f"faults.lose_slm_from_show={SHOW}").status == 6
    assert said[-1] == "off"


def test_every_fault_of_the_table_has_a_case():
    asked = {item.partition("=")[0] for case in CASES for item in case.sets.split()}
    # A mirrored picture is noticed by a procedure that knows what it shows; a size makes a swapped camera another.
    assert set(FaultTable.model_fields) - asked == {"mirror", "swapped_size"}


def test_faults_are_no_part_of_what_a_rig_is(tiny):
    from holocal.records.plugins import RIGS, load
    from holocal.records.rig import identity, load_rig

    def asked(*sets: str) -> dict[str, Any]:
        return identity(load(RIGS, "simulated")(load_rig("tiny.toml", sets)).facts())

    plain = asked()
    some = ("faults.stale_at_grab=3", "faults.mirror=x", "faults.drift_per_grab=0.1", "faults.latency_frames=2")
    assert asked(*some) == plain
    other = asked("faults.swapped_camera=true", "faults.swapped_size=[64, 60]")
    differing = {key for key in plain if plain[key] != other[key]}
    assert differing == {"camera.serial", "camera.width", "camera.height", "camera.field_rad"}


def test_an_unknown_or_impossible_fault_is_refused_by_its_key(holocal, tiny):
    unknown = holocal(*RUN, "--set", "faults.stale_grab=3")
    assert unknown.status == 2 and "stale_at_grab" in unknown.json["error"]["what"]
    assert holocal(*RUN, "--set", "faults.stale_at_grab=0").status == 2
    wide = holocal(*RUN, "--set", "faults.left_justified=true", "--set", "camera.bits=16")
    assert wide.status == 2 and "camera.bits" in wide.json["error"]["fix"]


def test_the_manual_has_every_fault_gate_and_check():
    manual = (Path(__file__).parents[2] / "docs" / "technician.md").read_text()
    rows = [line for line in manual.splitlines() if line.startswith("|")]
    faults = rows[rows.index("| fault | key | what notices it | exit status |") + 2 :]
    told = {key for row in faults for key in re.findall(r"`([a-z_]+)[ `]", row.split("|")[2])}
    assert told == set(FaultTable.model_fields)
    statuses = {key: row.split("|")[-2] for row in faults for key in FaultTable.model_fields if f"`{key}" in row}
    for case in CASES:
        key = case.sets.split()[0].partition("=")[0]
        assert str(case.status) in statuses[key], case
    for name in ("misshapen", "lost-packets", "stale", "beyond-full-scale", "low-bits-zero", "constant", "identical"):
        assert any(row.startswith(f"| {name} |") for row in rows)
    assert all(any(row.startswith(f"| P{number:02d}") for row in rows) for number in range(1, 15))
