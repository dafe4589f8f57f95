"""The unchanged product on real protocols: window -> framebuffer -> bench -> GigE Vision -> driver, and lasers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from x_server import XServer, xorg

from holocal.errors import DeviceError
from holocal.records.manifest import read_manifest
from holocal.records.rig import identity, load_rig
from rigs.bench.process import BenchProcess, running, start
from rigs.devices import open_rig
from rigs.simulated.rig import SimulatedRig

pytestmark = pytest.mark.loopback

LOOPBACK = str(Path(__file__).parents[2] / "rigs" / "loopback.toml")
ON_XORG = ("slm.monitor=DUMMY1",)
DARK = 20  # which of the patterns is shown without light
CLI = "from holocal.app.cli.main import main; main()"


@pytest.fixture(scope="module")
def display(tmp_path_factory: pytest.TempPathFactory) -> Iterator[XServer]:
    """Xorg with the dummy driver, the panel of 960 x 540 on DUMMY1, as DISPLAY of this process and its children."""
    with xorg(tmp_path_factory.mktemp("xorg")) as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DISPLAY", server.display)
        patch.delenv("SDL_VIDEODRIVER", raising=False)
        yield server


def bench_arguments(server: XServer) -> tuple[str, ...]:
    return ("--display", server.display, "--monitor", "DUMMY1")


@pytest.fixture
def bench(display: XServer) -> Iterator[BenchProcess]:
    """The bench of loopback.toml."""
    with running(bench_arguments(display)) as process:
        yield process


@pytest.fixture
def small_display(display: XServer) -> Iterator[XServer]:
    """The same server with a quarter of the panel's pixels."""
    display.set_panel(480, 270)
    yield display
    display.set_panel(960, 540)


@pytest.fixture
def holocal(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """The command line in a process of its own, in an empty directory with a calibration home of its own."""
    started: list[subprocess.Popen[str]] = []

    def call(*arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", CLI, *arguments],
            cwd=tmp_path,
            env=os.environ | {"HOLOCAL_HOME": str(tmp_path / "home")},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield call
    for process in started:
        process.kill()
        process.communicate()


def test_forty_patterns_come_back_as_the_frames_that_the_simulated_bench_makes_of_them(small_display, say):
    """Nothing between the levels and the counts changes a bit, is late, or comes from the pattern before."""
    size = ["slm.width=480", "slm.height=270", "camera.width=300", "camera.height=250"]
    twin = SimulatedRig(load_rig("simulated-small", size))
    arguments = [part for override in size for part in ("--set", override)]
    exact, dark_exact = 0, 0
    with running([*bench_arguments(small_display), *arguments]):
        rig = open_rig(load_rig(LOOPBACK, [*ON_XORG, *size]))
        facts = rig.facts()
        for number, levels in enumerate(patterns(41)):
            for light in (rig.light, twin.light):
                light.select(515e-9 if number < 37 else 639e-9)
                (light.off if number == DARK else light.on)()
            assert rig.slm.show(levels).read_back_ok is True
            twin.slm.show(levels)
            used_s = rig.camera.set_exposure((0.004, 0.0251, 0.11)[number % 3])
            assert twin.camera.set_exposure(used_s) == pytest.approx(used_s, rel=1e-12)
            got, wanted = rig.camera.grab(), twin.camera.grab()
            same = np.array_equal(got.counts, wanted.counts) and got.lost_packets == 0
            exact += same and number != DARK
            dark_exact += same and number == DARK
        rig.close()
    say(f"end to end: {exact} of 40 frames pixel-exact and fresh, {dark_exact} of 1 dark")
    assert (exact, dark_exact) == (40, 1)
    assert facts.simulated and facts.camera.full_scale == 4095 and facts.camera.serial == "BENCH1"
    assert identity(facts)["simulated"] is True


def patterns(count: int) -> Iterator[np.ndarray]:
    """Yield random levels; every eighth comes twice: the same light, another noise."""
    rng = np.random.default_rng(7)
    levels = np.zeros((270, 480), np.uint8)
    for number in range(count):
        if number % 8 != 7:
            levels = rng.integers(0, 256, levels.shape, np.uint8)
        yield levels


def test_the_doctor_finds_the_bench_healthy(bench, holocal):
    done = holocal("doctor", "--rig", LOOPBACK, "--set", ON_XORG[0])
    out, err = done.communicate(timeout=120)
    assert done.returncode == 0, err
    verdicts = {
        line.split()[1]: line.split()[0] for line in out.splitlines() if line.split()[1:2] and line.split()[1][0] == "P"
    }
    assert verdicts["P05"] == verdicts["P10"] == verdicts["P11a"] == "pass"


def test_uniformity_meets_its_targets_and_is_never_accepted_for_a_real_bench(bench, holocal, say):
    done = holocal("run", "uniformity", "--rig", LOOPBACK, "--set", ON_XORG[0], "--json")
    out, err = done.communicate(timeout=300)
    assert done.returncode == 0, err
    result = json.loads(out)
    say(f"uniformity over real protocols: {result['sentence']} ({result['seconds']:.0f} s)")
    assert result["targets_met"] is True and "truth" not in result
    assert result["before"]["nonuniformity_rms"] > 0.1  # there was something to correct
    assert json.loads((Path(result["run"]) / "identity.json").read_text())["simulated"] is True


def test_a_run_that_loses_its_bench_ends_with_6_and_goes_on_when_it_is_back(display, holocal, tmp_path):
    first = start(*bench_arguments(display))
    run = holocal(
        "run", "uniformity", "--rig", LOOPBACK, "--set", ON_XORG[0], "--set", "camera.timeout_s=8.0", "--json"
    )
    wait_for_step(tmp_path / "runs", 1)
    first.kill()
    out, err = run.communicate(timeout=120)
    assert run.returncode == 6, err
    assert "resume" in err
    (directory,) = (tmp_path / "runs").iterdir()
    assert read_manifest(directory)["status"] == "interrupted"
    with running(bench_arguments(display)):
        resumed = holocal("resume", str(directory), "--json")
        out, err = resumed.communicate(timeout=300)
    assert resumed.returncode == 0, err
    assert json.loads(out)["targets_met"] is True
    assert read_manifest(directory)["status"] == "complete"


def test_a_bench_that_cannot_make_a_picture_ends_instead_of_sending_an_old_one(display):
    bench = start(*bench_arguments(display))
    rig = open_rig(load_rig(LOOPBACK, [*ON_XORG, "camera.timeout_s=3.0"]))
    rig.camera.grab()
    rig.light.lasers[0].switch(on=True)  # two lasers at once: there is one beam
    rig.light.lasers[1].switch(on=True)
    with pytest.raises(DeviceError) as caught:
        rig.camera.grab()
    assert caught.value.exit_status == 6
    with pytest.raises(DeviceError):  # the lasers are gone with the bench, and nobody pretends that they are off
        rig.close()
    assert bench.stop() == 70


def wait_for_step(runs: Path, number: int) -> None:
    """Return when the only run under a directory has finished so many steps."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        for journal in runs.glob("*/events.jsonl"):
            if sum('"step"' in line for line in journal.read_text().splitlines()) >= number:
                return
        time.sleep(0.05)
    raise AssertionError(f"no run under {runs} has finished {number} steps")
