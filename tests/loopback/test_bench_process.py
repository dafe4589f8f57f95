"""The bench as a person starts it: with Xvfb, and ended by a signal or with the program that started it."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rigs.bench.process import start
from rigs.genicam_discovery import discover

pytestmark = pytest.mark.loopback

SMALL = ("--set", "slm.width=96", "--set", "slm.height=64", "--set", "camera.width=64", "--set", "camera.height=64")


def free_display() -> str:
    """Return a display number that no X server of this host has."""
    sockets = Path("/tmp/.X11-unix")
    taken = {path.name for path in sockets.iterdir()} if sockets.is_dir() else set()
    return next(f":{number}" for number in range(150, 1000) if f"X{number}" not in taken)


def test_it_starts_xvfb_says_where_everything_is_and_ends_with_the_pipe():
    where = free_display()
    bench = start("--xvfb", where, "--serial", "B-7", "--light-port", "0", *SMALL)
    assert bench.said.startswith(f"ready DISPLAY={where} monitor screen camera B-7 at 127.0.0.1")
    assert [seen.serial for seen in discover()] == ["B-7"]
    host, port = bench.said.split()[-1].removeprefix("socket://").split(":")
    with socket.create_connection((host, int(port)), timeout=5) as laser:
        laser.sendall(b"*IDN?\r\n")
        assert b"bench laser 639nm" in laser.recv(200)
    assert bench.stop() == 0
    assert discover() == ()
    assert not Path(f"/tmp/.X11-unix/X{where[1:]}").exists()  # and Xvfb with it


def test_a_signal_ends_it_and_a_second_bench_is_refused():
    where = free_display()
    bench = start("--xvfb", where, *SMALL)
    second = subprocess.run(
        [sys.executable, "-m", "rigs.bench", "--display", where, "--light-port", "0", *SMALL],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert second.returncode == 75 and "UDP 3956" in second.stderr
    bench.process.send_signal(signal.SIGTERM)
    assert bench.process.wait(20) == 0
    assert bench.stop() == 0


def test_a_monitor_of_another_size_than_the_panel_is_refused():
    wrong = subprocess.run(
        [sys.executable, "-m", "rigs.bench", "--xvfb", free_display(), "--monitor", "HDMI-1", *SMALL],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert wrong.returncode == 2 and "'HDMI-1'" in wrong.stderr and "screen" in wrong.stderr
