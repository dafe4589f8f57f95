"""The panel in a process of its own: signals reach Python, and a display that ends does not end the process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from x_server import XServer, xorg

pytestmark = pytest.mark.loopback

CHILD = """
import signal, sys
import numpy as np
from holocal.errors import DeviceError
from rigs.context import DriverContext
from rigs.hdmi_slm import open_slm

def attempt(name, call):
    try:
        print(name, "returned", type(call()).__name__, flush=True)
    except DeviceError as error:
        print(name, "raised", error.exit_status, error.code, flush=True)

panel = {"monitor": "DUMMY1", "width": 960, "height": 540, "pitch_um": 8.0, "settle_ms": 0.0}
slm = open_slm(panel, DriverContext("bench-a", "bench-a.toml", ()))
levels = np.random.default_rng(0).integers(0, 256, (540, 960), np.uint8)
"""


def test_sigterm_and_sigint_reach_python_while_the_window_is_up(x_server: XServer) -> None:
    code = """
def stop(number, frame):  # as `holocal.loop.signals` has it: leave by an exception, and close on the way out
    raise KeyboardInterrupt(signal.Signals(number).name)

slm.show(levels)
for number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(number, stop)
try:
    print("up", flush=True)
    while True:
        slm.show(levels)
except KeyboardInterrupt as stopped:
    slm.close()
    print("python got", stopped, flush=True)
    raise SystemExit(7)
"""
    for number in (signal.SIGTERM, signal.SIGINT):
        child = start(code, x_server)
        assert child.stdout.readline() == "up\n"
        child.send_signal(number)
        said, trouble = child.communicate(timeout=30)
        assert (said, child.returncode) == (f"python got {number.name}\n", 7), trouble


def test_sigterm_without_a_handler_ends_the_process_as_ever(x_server: XServer) -> None:
    child = start('slm.show(levels)\nprint("up", flush=True)\nwhile True: slm.show(levels)\n', x_server)
    assert child.stdout.readline() == "up\n"
    child.terminate()
    child.communicate(timeout=30)
    assert child.returncode == -signal.SIGTERM  # SDL would have swallowed it


def test_a_lost_x_server_is_a_device_error_and_the_process_lives(tmp_path: Path) -> None:
    code = """
slm.show(levels)
print("up", flush=True)
sys.stdin.readline()
attempt("show", lambda: slm.show(levels))
attempt("show", lambda: slm.show(levels))
attempt("inspect", slm.inspect)
attempt("blank", slm.blank)
attempt("close", slm.close)
attempt("close", slm.close)
attempt("open", lambda: open_slm(panel, DriverContext("bench-a", "bench-a.toml", ())))
"""
    with xorg(tmp_path) as server:
        child = start(code, server)
        assert child.stdout.readline() == "up\n"
        server.kill()
        said, trouble = child.communicate("\n", timeout=60)
    assert said.splitlines() == [
        "show raised 6 display-lost",
        "show raised 6 display-lost",
        "inspect raised 6 display-lost",
        "blank returned NoneType",
        "close returned NoneType",
        "close returned NoneType",
        "open raised 6 display-lost",
    ], trouble
    assert child.returncode == 0, trouble


def test_a_server_lost_before_blank_or_close_stops_neither(tmp_path: Path) -> None:
    with xorg(tmp_path) as server:
        code = (
            'print("up", flush=True)\nsys.stdin.readline()\nattempt("blank", slm.blank)\nattempt("close", slm.close)\n'
        )
        bare = "from rigs.hdmi.window import PanelWindow\nwindow = PanelWindow(slm._place)\n"
        last = 'print("up", flush=True)\nsys.stdin.readline()\nattempt("close", window.close)\n'
        closing = start(bare + last, server)
        assert closing.stdout.readline() == "up\n"
        blanking = start(code, server)
        assert blanking.stdout.readline() == "up\n"
        server.kill()
        assert closing.communicate("\n", timeout=60)[0] == "close returned NoneType\n"
        assert blanking.communicate("\n", timeout=60)[0] == "blank returned NoneType\nclose returned NoneType\n"
    assert (closing.returncode, blanking.returncode) == (0, 0)


def test_a_run_whose_display_ends_stops_resumable_with_the_light_off(tmp_path: Path) -> None:
    code = """
import os
from pathlib import Path
from lab_bench.levelling import Levelling, Parameters
from lab_bench.rig import LabRig
from holocal.loop.record import RunRecord
from holocal.loop.runner import run
from holocal.records.rig import load_rig
from rigs.hdmi_slm import HdmiSlm

class Both(HdmiSlm):  # the lab's camera looks at the levels of its own panel
    def show(self, levels):
        rig.eye.show(levels)
        return super().show(levels)

class Watcher:
    def preflight(self, checks, seconds): ...
    def waiting(self, what): ...
    def incident(self, sentence): ...
    def step(self, number, progress, judgement):
        print("step", number, flush=True)
        sys.stdin.readline()

rig = LabRig(load_rig("lab-bench", ["slm.width=960", "slm.height=540"]))
rig.eye, slm.__class__, rig.slm = rig.slm, Both, slm
record = RunRecord.create(Path(sys.argv[1]), "levelling", config="", identity={})
with record.open():
    try:
        run(Levelling(), rig, Parameters(), seed=1, record=record, calibration={}, observer=Watcher())
    except DeviceError as error:
        print(error.exit_status, error.code, "light", rig.light.lit, flush=True)
slm.close()
"""
    with xorg(tmp_path) as server:
        child = start(code, server, str(tmp_path))
        assert child.stdout.readline() == "step 1\n"
        server.kill()
        said, trouble = child.communicate("\n", timeout=60)
    assert said == "6 display-lost light False\n", trouble
    assert child.returncode == 0, trouble
    (run,) = tmp_path.glob("*-levelling-*")
    assert json.loads((run / "manifest.json").read_text())["status"] == "interrupted"


_children: list[subprocess.Popen[str]] = []


@pytest.fixture(autouse=True)
def no_child_is_left() -> Iterator[None]:
    yield
    for child in _children:
        if child.poll() is None:
            child.kill()
        child.wait()
    _children.clear()


def start(code: str, server: XServer, *arguments: str) -> Any:
    paths = [str(Path(__file__).parents[1] / "lab"), str(Path(__file__).parents[2])]
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD + code, *arguments],
        env=server.environment() | {"PYTHONPATH": os.pathsep.join(paths)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    _children.append(child)
    return child
