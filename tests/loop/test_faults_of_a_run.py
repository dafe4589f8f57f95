"""Faults in the middle of the main job, with real holograms on a small simulated bench."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from holocal.app.cli.main import invoke
from holocal.records.maps import read_maps

pytestmark = pytest.mark.slow

# A twelfth of the small bench's panel and a tenth of its camera: 15 s a run. Its targets are beside the point here.
SMALL = [
    "run", "uniformity", "--rig", "simulated-small", "--seed", "5", "--json",
    "--set", "slm.width=320", "--set", "slm.height=180", "--set", "camera.width=240", "--set", "camera.height=240",
    "--set", "block_px=12", "--set", "max_steps=1", "--set", "target_rms=0.5", "--set", "target_9pt=0.9",
]  # fmt: skip
ALWAYS = ("before", "after", "steps", "frames", "targets_met", "registration")


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("HOLOCAL_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def go(capfd, *arguments: str) -> tuple[int, dict]:
    capfd.readouterr()
    status = invoke(list(arguments))
    return status, json.loads(capfd.readouterr().out)


def test_a_run_that_lost_its_device_resumes_to_the_result_of_an_undisturbed_one(place, capfd):
    status, undisturbed = go(capfd, *SMALL)
    assert status == 0
    # In turn: in the middle of the first measurement, and of the corrected frames.
    first = undisturbed["preflight_frames"] + 1
    for fault in (f"lose_camera_from_grab={first + 3}", f"ignore_shows_from={3 + 5}"):
        status, error = go(capfd, *SMALL, "--runs", fault, "--set", f"faults.{fault}")
        assert (status, error["error"]["code"]) in {(6, "device-lost"), (6, "gate-unchanged")}
        (directory,) = Path(fault).iterdir()
        status, resumed = go(capfd, "resume", str(directory), "--json")
        assert status == 0
        assert {key: resumed[key] for key in ALWAYS} == {key: undisturbed[key] for key in ALWAYS}
        kept, now = (read_maps(Path(run) / "maps.exr").channels for run in (undisturbed["run"], resumed["run"]))
        assert all(np.array_equal(kept[name], now[name], equal_nan=True) for name in kept)


@pytest.mark.parametrize("mirror", ["x", "y", "xy"])
def test_a_mirrored_picture_is_refused_by_the_procedure_that_knows_what_it_shows(place, capfd, mirror):
    status, error = go(capfd, *SMALL, "--set", f"faults.mirror={mirror}")
    assert (status, error["error"]["code"]) == (4, "not-registered")
    (directory,) = Path("runs").iterdir()
    assert list((directory / "frames").glob("*blobs*.png"))


def test_another_camera_than_the_calibrations_is_refused_naming_field_and_both_values(place, capfd):
    status, done = go(capfd, *SMALL)
    assert status == 0
    assert invoke(["accept", done["run"]]) == 0
    swapped = ("--set", "faults.swapped_camera=true")
    status, error = go(capfd, *SMALL, *swapped)
    assert (status, error["error"]["code"]) == (4, "other-rig")
    assert (error["error"]["measured"], error["error"]["limit"]) == ("C0", "C0-other")
    assert "camera.serial" in error["error"]["what"]
    sets = [word for word in SMALL[SMALL.index("--set") :] if word != "--set"]
    of_rig = [part for word in sets if word.startswith(("slm", "camera")) for part in ("--set", word)]
    status, told = go(capfd, "doctor", "--rig", "simulated-small", *of_rig, *swapped, "--json")
    assert status == 4
    (check,) = [check for check in told["checks"] if check["id"] == "P03"]
    assert check["verdict"] == "fail" and check["measured"] == "camera.serial = 'C0-other'"
    assert check["limit"] == "'C0' (the accepted uniformity calibration)"
    # Without the calibration the other camera can be measured: that is how a bench gets its new one.
    status, told = go(capfd, "doctor", "--rig", "simulated-small", *of_rig, "--json")
    assert status == 0
    (age,) = [check for check in told["checks"] if check["id"] == "P14"]
    assert age["verdict"] == "pass" and 0 <= age["measured"] < 0.1
