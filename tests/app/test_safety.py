"""The bench is dark on every way out, exposures keep to the rig's ceiling, and nothing raises a laser's power.

With real processes and real signals; the bench keeps a diary in a file, so that it can be read after its process ended.
"""

from __future__ import annotations

import ast
import inspect
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab_bench.rig import LabRig

import holocal as package
from holocal.errors import DeviceError, SafetyStop
from holocal.loop.devices import Light
from holocal.loop.ending import dark_at_the_end
from holocal.loop.procedure import Shot
from holocal.loop.shooting import Shooter
from holocal.records.frames import write_frame
from holocal.records.rig import load_rig

LAB = Path(__file__).parents[1] / "lab"
SLOW = ("--set", "faults.slow_s=0.2")
COMMANDS = {
    "run": ("run", "levelling", "--seed", "3", "--json", "--set", "steps=6"),
    "doctor": ("doctor", "--json"),
    "capture": ("capture", "frame.png", "--json"),
}
# Of the run: after the 13 frames of the pre-flight and two steps; the other two take 13 and 2 or more.
GRABS = {"run": 15, "doctor": 6, "capture": 1}


def begun(place: Path, command: tuple[str, ...], *sets: str) -> subprocess.Popen[bytes]:
    """Start a command of the program in a process of its own, on the bench with a diary."""
    write_frame(place / "frame.png", np.random.default_rng(5).integers(0, 256, (24, 32), np.uint8))
    words = [*command, "--rig", "lab-bench", "--set", f"faults.diary={place / 'diary'}", *sets]
    # Whoever runs these tests may ignore the signals that a child would inherit so, as `nohup` does.
    main = "import signal as s; s.signal(s.SIGHUP, s.SIG_DFL); from holocal.app.cli.main import main; main()"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(LAB), os.environ.get("PYTHONPATH", "")])}
    return subprocess.Popen(
        [sys.executable, "-c", main, *words], cwd=place, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def diary(place: Path) -> list[str]:
    path = place / "diary"
    return path.read_text().split() if path.is_file() else []


def wait_for(place: Path, word: str, times: int) -> None:
    deadline = time.monotonic() + 60
    while diary(place).count(word) < times:
        assert time.monotonic() < deadline, diary(place)
        time.sleep(0.02)


def is_dark(words: list[str]) -> bool:
    """Return whether the last thing done to the light was off, and to the panel blank."""
    light = [word for word in words if word in ("on", "off")]
    panel = [word for word in words if word in ("show", "blank")]
    return light[-1] == "off" and panel[-1] == "blank"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_signal_leaves_the_bench_dark_and_exits_130(workplace, name, number):
    process = begun(workplace, COMMANDS[name], *SLOW)
    wait_for(workplace, "grab", GRABS[name])
    assert not is_dark(diary(workplace))
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert is_dark(diary(workplace))
    assert json.loads(out)["error"]["exit_status"] == 130
    assert b"Traceback" not in err


def test_an_interrupted_run_is_resumed_and_a_second_signal_does_not_wait_for_the_step(holocal, workplace):
    process = begun(workplace, COMMANDS["run"], "--set", "faults.slow_s=0.5")
    wait_for(workplace, "grab", 14)  # the first of the run begins, 0.5 s long
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.1)
    asked = time.monotonic()
    process.communicate(timeout=60)
    grabs = diary(workplace).count("grab")
    assert process.returncode == 130
    assert is_dark(diary(workplace))
    assert grabs <= 15 and time.monotonic() - asked < 30
    (directory,) = (workplace / "runs").iterdir()
    assert json.loads((directory / "manifest.json").read_text())["status"] == "interrupted"
    resumed = holocal("resume", str(directory), "--json")
    assert resumed.status == 0, resumed.err
    assert resumed.json["steps"] == 6


def test_a_signal_while_the_rig_is_being_opened_closes_it_again(workplace):
    process = begun(
        workplace, COMMANDS["doctor"], "--set", "faults.slow_open_s=0.8", "--set", "faults.lit_when_opened=true"
    )
    wait_for(workplace, "open", 1)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert is_dark(diary(workplace)) and "grab" not in diary(workplace)


def test_what_a_killed_process_left_on_is_switched_off_first_by_the_next(workplace):
    process = begun(workplace, COMMANDS["run"], *SLOW)
    wait_for(workplace, "grab", 8)
    process.kill()  # cannot be caught: the bench stays lit
    process.communicate(timeout=60)
    assert not is_dark(diary(workplace))
    before = len(diary(workplace))
    process = begun(workplace, COMMANDS["capture"], "--set", "faults.lit_when_opened=true")
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert diary(workplace)[before:][:4] == ["on", "open", "off", "blank"]
    assert is_dark(diary(workplace))


def test_a_light_that_cannot_be_switched_off_is_said_whatever_else_ended_the_run():
    rig = LabRig(load_rig("lab-bench"))

    def stuck() -> None:
        raise ConnectionError("no answer from the laser")

    rig.light.off = stuck  # type: ignore[method-assign]
    with pytest.raises(DeviceError) as caught, dark_at_the_end(rig):
        raise SafetyStop("too bright.")
    assert caught.value.code == "light-not-off"
    assert "too bright" in caught.value.what and "by hand" in caught.value.fix
    assert rig.slm.blanked == 1


def test_a_panel_that_is_lost_does_not_hide_what_ended_the_run():
    rig = LabRig(load_rig("lab-bench"))

    def lost() -> None:
        raise ConnectionError("no panel")

    rig.slm.blank = lost  # type: ignore[method-assign]
    with pytest.raises(SafetyStop), dark_at_the_end(rig):
        raise SafetyStop("too bright.")
    assert rig.light.history == [False]
    with pytest.raises(DeviceError) as caught, dark_at_the_end(rig):
        pass
    assert caught.value.code == "panel-not-blank"


def exposures(place: Path) -> list[float]:
    """Return every exposure that a run's journal names."""
    (directory,) = (place / "runs").iterdir()
    lines = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    return [shot["exposure_s"] for line in lines for shot in line.get("shots", [])]


def test_no_exposure_is_longer_than_the_rig_allows(holocal, workplace, monkeypatch):
    from rigs.simulated.rig import SimulatedCamera

    asked: list[float] = []
    set_exposure = SimulatedCamera.set_exposure

    def noted(camera: SimulatedCamera, exposure_s: float) -> float:
        asked.append(exposure_s)
        return set_exposure(camera, exposure_s)

    monkeypatch.setattr(SimulatedCamera, "set_exposure", noted)
    (workplace / "tiny.toml").write_text(
        'kind = "simulated"\n[slm]\nwidth = 128\nheight = 72\n[optics]\npupil_mm = 1.0\npupil_edge_mm = 0.1\n'
        "[camera]\nwidth = 96\nheight = 80\nfield_deg = 6.0\n[safety]\nmax_exposure_s = 0.25\n"
    )
    answer = holocal("run", "levelling", "--rig", "tiny.toml", "--set", "exposure_s=0.9", "--json")
    assert answer.status == 0, answer.err
    assert max(asked) <= 0.25  # the pre-flight's among them
    assert set(exposures(workplace)) == {0.25}
    planned = holocal("run", "uniformity", "--rig", "tiny.toml", "--dry-run", "--json").json
    assert planned["exposure_ceiling_s"] == 0.25


def test_a_rig_whose_plug_in_does_not_keep_to_its_own_ceiling_is_refused(holocal):
    answer = holocal("run", "levelling", "--rig", "lab-bench", "--set", "safety.max_exposure_s=0.05", "--json")
    assert answer.status == 4
    assert answer.json["error"]["code"] == "exposure-ceiling"
    assert (answer.json["error"]["measured"], answer.json["error"]["limit"]) == (0.1, 0.05)
    wrong = holocal("run", "levelling", "--rig", "lab-bench", "--set", "safety.max_power_w=1", "--json")
    assert wrong.status == 2 and "max_power_w" in wrong.json["error"]["what"]


def test_a_camera_that_makes_more_of_an_exposure_than_it_may_is_a_safety_stop():
    rig = LabRig(load_rig("lab-bench"))
    rig.camera.set_exposure = lambda exposure_s: 5 * exposure_s  # type: ignore[method-assign]
    shooter = Shooter(rig, rig.facts(), lambda *_: None)
    levels = np.zeros((24, 32), np.uint8)
    with pytest.raises(SafetyStop) as caught:
        shooter.shoot(Shot("square", levels, 0.05, 515e-9))
    assert caught.value.code == "exposure-ceiling"
    assert (caught.value.measured, caught.value.limit) == (0.25, 0.1)


def test_a_light_can_be_switched_and_chosen_and_nothing_else():
    calls = {name for name, _ in inspect.getmembers(Light, inspect.isfunction) if not name.startswith("_")}
    assert calls == {"select", "on", "off"}


def test_no_code_asks_a_light_for_more_than_on_off_and_which_line():
    root = Path(package.__file__).parents[1]
    asked: dict[str, set[str]] = {}
    for path in [*root.glob("holocal/**/*.py"), *root.glob("procedures/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and _is_light(node.value):
                asked.setdefault(node.attr, set()).add(path.name)
    assert set(asked) == {"select", "on", "off"}, asked


def _is_light(node: Any) -> bool:
    return isinstance(node, ast.Attribute) and node.attr == "light"
