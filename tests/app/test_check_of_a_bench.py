"""``holocal check`` of the simulated bench: what was accepted holds, and a mirror that moved is found."""

from __future__ import annotations

import pytest

RIG = ("--rig", "simulated-small")


@pytest.mark.slow
def test_a_mirror_that_turned_by_10_millidegrees_after_accept_is_a_drift(holocal):
    """The misalignment is no part of a rig's identity: it is the same rig, and the calibration no longer holds.

    The mirror's 0.01 degrees move the picture by 0.02 degrees, half a camera pixel: five times the limit.
    """
    for procedure in ("distortion", "uniformity"):
        run = holocal("run", procedure, *RIG, "--seed", "1", "--json")
        assert run.status == 0, run.err
        assert holocal("accept", run.json["run"]).status == 0
    holds = holocal("check", *RIG, "--json")
    assert holds.status == 0, holds.err
    assert {one["procedure"]: one["verdict"] for one in holds.json["checked"]} == {
        "distortion": "holds",
        "uniformity": "holds",
    }
    turned = holocal("check", *RIG, "--set", "misalignment.mirror_rotation_deg=[0.16,-0.2,0.1]", "--json")
    assert turned.status == 3, turned.err
    verdicts = {one["procedure"]: one for one in turned.json["checked"]}
    assert verdicts["distortion"]["verdict"] == "drifted"
    number = verdicts["distortion"]["numbers"]["rms_px"]
    assert number["value"] > 3 * number["limit"]
    far = holocal("check", *RIG, "--set", "misalignment.mirror_rotation_deg=[1.5,-0.2,0.1]", "--json")
    assert far.status == 3, far.err


@pytest.mark.slow
def test_a_panel_of_another_response_is_another_rig(holocal):
    """What is part of the identity (the panel, the optics, which camera) is refused, not measured."""
    run = holocal("run", "distortion", *RIG, "--json")
    assert holocal("accept", run.json["run"]).status == 0
    answer = holocal("check", *RIG, "--set", "slm.fill_factor=0.9", "--json")
    assert answer.status == 4
    assert "slm.fill_factor" in answer.json["error"]["what"]
