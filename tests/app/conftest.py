"""What the tests of the command line share."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from holocal.app.cli.main import invoke


@dataclass(frozen=True)
class Answer:
    """What a command line ended with."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """The one object on stdout."""
        found = json.loads(self.out)
        assert isinstance(found, dict)
        return found


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty directory to work in, with a calibration home of its own."""
    monkeypatch.setenv("HOLOCAL_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def holocal(workplace: Path, capfd: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """The command line, in this process."""

    def call(*arguments: str) -> Answer:
        status = invoke([str(argument) for argument in arguments])
        said = capfd.readouterr()
        return Answer(status, said.out, said.err)

    return call
