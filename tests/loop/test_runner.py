"""The runner leaves the bench dark on every way out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from lab_bench.levelling import Levelling, Parameters
from lab_bench.rig import LabRig

from holocal.errors import DeviceError, HolocalError, Interrupted
from holocal.loop.record import RunRecord
from holocal.loop.runner import run
from holocal.records.rig import load_rig


class Watcher:
    """An observer that remembers, and may pull the plug."""

    def __init__(self, rig: LabRig, stop_at: int | None = None) -> None:
        self.rig, self.stop_at = rig, stop_at
        self.steps: list[int] = []

    def preflight(self, checks: Any, seconds: float) -> None:
        assert not self.rig.light.history or self.rig.slm.blanked == 0

    def waiting(self, what: str) -> None: ...

    def incident(self, sentence: str) -> None: ...

    def step(self, number: int, progress: Any, judgement: Any) -> None:
        self.steps.append(number)
        if number == self.stop_at:
            raise KeyboardInterrupt


def go(tmp_path: Path, *faults: str, stop_at: int | None = None, **parameters: Any) -> tuple[LabRig, Any]:
    rig = LabRig(load_rig("lab-bench", [f"faults.{fault}" for fault in faults]))
    record = RunRecord.create(tmp_path, "levelling", config="", identity={})
    with record.open():
        try:
            done = run(
                Levelling(),
                rig,
                Parameters(**parameters),
                seed=1,
                record=record,
                calibration={},
                observer=Watcher(rig, stop_at),
            )
        except (HolocalError, ZeroDivisionError) as error:
            return rig, error
    return rig, done


@pytest.mark.parametrize(
    ("faults", "parameters", "ends_with"),
    [
        ((), {}, None),
        (("kind=unplugged",), {}, DeviceError),
        (("kind=frozen-panel",), {}, HolocalError),
        ((), {"bug_at": 1}, ZeroDivisionError),
        ((), {"stop_at": 1}, Interrupted),
    ],
)
def test_the_light_is_off_and_the_panel_blank_on_every_way_out(tmp_path, faults, parameters, ends_with):
    rig, ended = go(tmp_path, *faults, **parameters)
    assert ends_with is None or isinstance(ended, ends_with)
    assert rig.light.history[-1] is False and not rig.light.lit
    assert rig.slm.blanked >= 1 and not rig.slm.levels.any()


def test_the_light_goes_off_even_when_the_panel_cannot_be_blanked(tmp_path):
    rig = LabRig(load_rig("lab-bench"))
    rig.light.on()

    def lost() -> None:
        raise DeviceError("the panel is gone.")

    rig.slm.blank = lost
    record = RunRecord.create(tmp_path, "levelling", config="", identity={})
    with record.open(), pytest.raises(DeviceError):
        run(Levelling(), rig, Parameters(), seed=1, record=record, calibration={}, observer=Watcher(rig))
    assert not rig.light.lit


def test_light_that_clips_after_three_halvings_is_a_safety_stop(tmp_path):
    rig = LabRig(load_rig("lab-bench"))
    rig.camera.faults["kind"] = "none"
    _, ended = go(tmp_path, exposure_s=1.0)  # bounded by the camera to 0.1 s, five times too long: two halvings
    assert not isinstance(ended, HolocalError)
    assert rig.camera.exposure_s == 0.02
