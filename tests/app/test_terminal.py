"""What is said on stderr when nobody is there to read it."""

from __future__ import annotations

import errno
import io
import sys

import pytest

from holocal.app.terminal import Terminal


class ClosedTerminal(io.StringIO):
    """A terminal that was closed: what is written to it is an error."""

    refused = 0

    def write(self, text: str) -> int:
        self.refused += 1
        raise OSError(errno.EIO, "Input/output error")


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_that_was_closed_does_not_end_a_run(monkeypatch, terminal):
    closed = ClosedTerminal()
    monkeypatch.setattr(closed, "isatty", lambda: terminal)
    monkeypatch.setattr(sys, "stderr", closed)
    with Terminal() as said:
        said.waiting("a frame")
        said.say("found")
        said.incident("a frame was lost")
    assert closed.refused
