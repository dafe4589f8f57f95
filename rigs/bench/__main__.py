"""``python -m rigs.bench``: a bench for the rig ``loopback`` in a process of its own. Prints "ready ..." and serves.

It ends on SIGTERM and Ctrl-C, and, when its stdin is a pipe, when that is closed: with the program that started it.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from holocal.errors import ConfigError, HolocalError
from holocal.records.rig import load_rig
from rigs.bench.gige_server import GigeServer
from rigs.bench.lasers import Laser, LaserServer
from rigs.bench.monitor import Monitor
from rigs.bench.twin import US, Twin

XVFB_OUTPUT = "screen"  # the name of its one output
SERVER_S = 20.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit status of a bench that has ended."""
    asked = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO if asked.verbose else logging.WARNING, stream=sys.stderr)
    try:
        with ExitStack() as stack:
            _serve(asked, stack)
            _wait()
    except HolocalError as error:
        sys.stderr.write(f"error {error.code}: {error}\n")
        return error.exit_status
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m rigs.bench", description=__doc__)
    parser.add_argument("--rig", default="simulated-small", help="the simulated rig that is behind the devices")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one value of it")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--display", help="an X server that runs, for example :0")
    where.add_argument("--xvfb", metavar="DISPLAY", help="start Xvfb there, with one screen of the panel's size")
    parser.add_argument("--monitor", default=XVFB_OUTPUT, help="the output that is the panel (xrandr names them)")
    parser.add_argument("--serial", default="BENCH1", help="the camera's serial number")
    parser.add_argument("--address", default="127.0.0.1", help="the address that the camera answers on")
    parser.add_argument("--light-port", type=int, default=9000, help="TCP port of the first laser; the others follow")
    parser.add_argument("--verbose", action="store_true", help="say on stderr what is served")
    return parser


def _serve(asked: argparse.Namespace, stack: ExitStack) -> None:
    """Start everything and say so; `stack` ends it."""
    simulated = load_rig(asked.rig, asked.set).simulated
    panel, sensor = simulated.slm, simulated.camera
    if asked.xvfb:
        stack.enter_context(_xvfb(asked.xvfb, panel.width, panel.height))
    os.environ["DISPLAY"] = asked.xvfb or asked.display
    monitor = Monitor(asked.monitor)
    if (monitor.place.width, monitor.place.height) != (panel.width, panel.height):
        raise ConfigError(
            f"monitor {asked.monitor} has {monitor.place.width} x {monitor.place.height} pixels, the panel of "
            f"{asked.rig} {panel.width} x {panel.height}.",
            fix="Set the monitor's mode, or --set slm.width and slm.height.",
            code="panel-size",
        )
    twin = Twin(asked.rig, tuple(asked.set), monitor.levels)
    twin.warm_up()
    facts = twin.bench().camera.describe()
    lasers = [
        Laser(line, serial=f"{asked.serial}-{line:g}", switched=twin.switched)
        for line in simulated.optics.wavelengths_nm
    ]
    lights = stack.enter_context(LaserServer(lasers, asked.light_port))
    stack.enter_context(
        GigeServer(
            twin.frame,
            width=sensor.width,
            height=sensor.height,
            exposure_us=(round(facts.exposure_min_s / US), round(facts.exposure_max_s / US)),
            serial=asked.serial,
            address=asked.address,
        )
    )
    sys.stdout.write(
        f"ready DISPLAY={os.environ['DISPLAY']} monitor {asked.monitor} camera {asked.serial} at {asked.address} "
        f"lasers {' '.join(lights.urls)}\n"
    )
    sys.stdout.flush()


def _wait() -> None:
    """Return on SIGTERM, SIGINT, or the end of a piped stdin."""
    ended = threading.Event()
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: ended.set())
    if stat.S_ISFIFO(os.fstat(0).st_mode):
        threading.Thread(target=_end_with_stdin, args=(ended,), daemon=True).start()
    ended.wait()


def _end_with_stdin(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


@contextmanager
def _xvfb(display: str, width: int, height: int) -> Iterator[None]:
    """Run Xvfb on a display until the block ends."""
    number = display.removeprefix(":")
    read, write = os.pipe()
    screen = f"{width}x{height}x24"
    command = ["Xvfb", f":{number}", "-screen", "0", screen, "-noreset", "-nolisten", "tcp", "-displayfd", str(write)]
    try:
        process = subprocess.Popen(command, pass_fds=[write])
    except FileNotFoundError as error:
        raise ConfigError("Xvfb is not installed.", fix="apt-get install xvfb", code="missing-program") from error
    finally:
        os.close(write)
    try:
        with os.fdopen(read, "rb") as answer:
            if not answer.readline():  # it ended: it writes its number when it is ready
                raise ConfigError(
                    f"Xvfb did not start on {display}.", fix="Choose a display number that is free.", code="no-display"
                )
        yield
    finally:
        process.terminate()
        process.wait(SERVER_S)


if __name__ == "__main__":
    sys.exit(main())
