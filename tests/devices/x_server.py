"""X servers for tests, without a graphics card: Xorg's dummy driver with two named outputs, and Xvfb with one screen.

DUMMY0 is the operator's monitor, DUMMY1 the panel's: a window on the wrong one, a wrong mode, a rotation, a gamma ramp
are all possible there, as on a real output. Xvfb has one screen of the panel's size and no gamma ramp.
"""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

# What these tests run on: the servers, xrandr and xset, and the libraries that SDL2 and mss load when they start.
APT_LINE = (
    "apt-get install -y xserver-xorg-core xserver-xorg-video-dummy xvfb x11-xserver-utils "
    "libxss1 libxcb-randr0 libxcb-render0 libxcb-shm0 libxcb-xfixes0"
)
OPERATOR = (1920, 1080)  # DUMMY0's mode
REFRESH_HZ = 60
LARGEST_CLOCK_HZ = 300e6  # the dummy driver's limit: 3840 x 2160 then comes at 34 Hz
STARTS = 8  # one start in three came up without DUMMY1: 3**-8 of them fail
PATIENCE_S = 20.0

CONFIG = """
Section "ServerFlags"
  Option "AutoAddDevices" "false"
  Option "AutoEnableDevices" "false"
  Option "DontVTSwitch" "true"
  Option "AllowMouseOpenFail" "true"
EndSection
Section "Device"
  Identifier "card"
  Driver "dummy"
  VideoRam 256000
EndSection
Section "Monitor"
  Identifier "monitor"
  HorizSync 5.0-1000.0
  VertRefresh 5.0-200.0
  Modeline "1920x1080" 148.50 1920 2008 2052 2200 1080 1084 1089 1125 +hsync +vsync
EndSection
Section "Screen"
  Identifier "screen"
  Device "card"
  Monitor "monitor"
  DefaultDepth 24
  SubSection "Display"
    Depth 24
    Modes "1920x1080"
    Virtual 5760 3840
  EndSubSection
EndSection
"""


@dataclass
class XServer:
    """A running X server: its display (":3"), its process, and what the tests do to its outputs."""

    display: str
    process: subprocess.Popen[bytes]

    def environment(self) -> dict[str, str]:
        """Return the environment of a client of this server."""
        return os.environ | {"DISPLAY": self.display}

    def run(self, *command: str) -> str:
        """Return what an X client prints."""
        done = subprocess.run(command, env=self.environment(), capture_output=True, text=True, timeout=30)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr.strip()}")
        return done.stdout

    def xrandr(self, *arguments: str) -> str:
        """Return what xrandr prints."""
        return self.run("xrandr", *arguments)

    def monitors(self) -> list[str]:
        """Return the names of the monitors that are lit."""
        return [line.split()[-1] for line in self.xrandr("--listmonitors").splitlines()[1:]]

    def set_panel(self, width: int, height: int, *, output: str = "DUMMY1") -> None:
        """Give an output a mode of that size, right of DUMMY0, upright, with a straight gamma ramp."""
        name = f"panel-{width}x{height}"
        if name not in self.xrandr():
            self.xrandr("--newmode", name, *modeline(width, height))
            self.xrandr("--addmode", output, name)
        place = ["--right-of", "DUMMY0"] if output != "DUMMY0" else []
        self.xrandr("--output", output, "--mode", name, *place, "--rotate", "normal", "--gamma", "1:1:1")

    def stop(self) -> None:
        """End the server, by its own process."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.process.kill()
        self.process.wait(10)

    def kill(self) -> None:
        """End the server at once, as a crash would."""
        self.process.kill()
        self.process.wait(10)


def modeline(width: int, height: int) -> list[str]:
    """Return the timings of a mode for ``xrandr --newmode``: short blanking, 60 Hz where the clock allows it."""
    total_x, total_y = width + 160, height + 30
    clock = min(REFRESH_HZ * total_x * total_y, LARGEST_CLOCK_HZ)
    across = [width, width + 48, width + 80, total_x]
    down = [height, height + 3, height + 8, total_y]
    return [f"{clock / 1e6:.3f}", *map(str, across + down), "+hsync", "-vsync"]


@contextmanager
def xorg(folder: Path, *, width: int = 960, height: int = 540) -> Iterator[XServer]:
    """Run Xorg with the dummy driver, the panel's mode on DUMMY1, until the block ends."""
    require("Xorg", "xrandr")
    if os.geteuid() != 0:
        raise RuntimeError("Xorg with the dummy driver needs root here; run these tests as root, as CI does.")
    config = folder / "xorg.conf"
    config.write_text(CONFIG)
    with ExitStack() as stack:
        for _ in range(STARTS):
            log = folder / "xorg.log"
            server = _start(
                ["Xorg", "-config", str(config), "-logfile", str(log), "-noreset", "-novtswitch", "-sharevts"], log
            )
            with ExitStack() as attempt:
                attempt.callback(server.stop)
                server.xrandr("--output", "DUMMY0", "--mode", "{}x{}".format(*OPERATOR), "--pos", "0x0")
                server.set_panel(width, height)
                if sorted(server.monitors()) == ["DUMMY0", "DUMMY1"]:
                    stack.push(attempt.pop_all())
                    break
        else:
            raise RuntimeError(f"Xorg came up {STARTS} times without both DUMMY0 and DUMMY1; see {log}.")
        yield server


@contextmanager
def xvfb(folder: Path, *, width: int = 960, height: int = 540) -> Iterator[XServer]:
    """Run Xvfb with one screen of the panel's size until the block ends; it needs no root."""
    require("Xvfb", "xrandr")
    server = _start(["Xvfb", "-screen", "0", f"{width}x{height}x24", "-noreset"], folder / "xvfb.log")
    try:
        yield server
    finally:
        server.stop()


def require(*programs: str) -> None:
    """Raise when a program is missing, with the line that installs it."""
    missing = [name for name in programs if shutil.which(name) is None]
    if missing:
        raise RuntimeError(f"{', '.join(missing)} not found; install: {APT_LINE}")


def _start(command: Sequence[str], log: Path) -> XServer:
    """Return a server that answers, on a display number that it found free itself."""
    read, write = os.pipe()
    with os.fdopen(read, "rb") as answer, log.with_suffix(".out").open("wb") as out:
        process = subprocess.Popen(
            [*command, "-nolisten", "tcp", "-displayfd", str(write)], pass_fds=[write], stdout=out, stderr=out
        )
        os.close(write)
        ready, _, _ = select.select([answer], [], [], PATIENCE_S)
        number = answer.readline().decode().strip() if ready else ""
    server = XServer(f":{number}", process)
    deadline = time.monotonic() + PATIENCE_S
    while number and process.poll() is None and time.monotonic() < deadline:
        try:
            server.xrandr()
            return server
        except RuntimeError:
            time.sleep(0.05)
    server.stop()
    raise RuntimeError(f"{command[0]} does not answer; its words: {log.with_suffix('.out').read_text()[-2000:]}")
