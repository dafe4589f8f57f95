"""What the tests over real protocols share. One GigE Vision camera per host: they take turns with any others."""

from __future__ import annotations

import fcntl
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def the_only_camera_of_this_host() -> Iterator[None]:
    """Hold the host's one GigE Vision control port for this session, waiting for another's tests to end."""
    with (Path(tempfile.gettempdir()) / "holocal-loopback.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture
def say(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]) -> Callable[[str], None]:
    """Write a line to the terminal: counts that a reader of the log should see though the test passes."""

    def write(line: str) -> None:
        with capsys.disabled():
            request.config.get_terminal_writer().line(f"\n{line}")

    return write
