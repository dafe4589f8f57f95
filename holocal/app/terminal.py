"""Progress, tables and errors on stderr; on stdout the result, or with ``--json`` exactly one JSON object.

On a terminal a line says what the run waits for; elsewhere each step is one plain line. ``NO_COLOR`` is honoured.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import IO, Any, TextIO, cast

from rich.console import Console
from rich.markup import escape
from rich.status import Status

from holocal.errors import HolocalError
from holocal.loop.preflight import Check
from holocal.loop.procedure import Judgement, Outcome
from holocal.records.files import dump_json

LINE = 110  # characters of a line where there is no terminal to ask


class _Stderr:
    """The stderr of now, whose reader may be gone: a terminal that was closed must not make a bug of a run's end."""

    @property
    def _real(self) -> TextIO:
        # While a status line is shown, rich puts a proxy in the place of sys.stderr that prints to this console.
        return cast(TextIO, getattr(sys.stderr, "rich_proxied_file", sys.stderr))

    @property
    def encoding(self) -> str:
        """What rich asks to know which characters can be written."""
        return self._real.encoding

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return self._real.isatty()

    def fileno(self) -> int:
        """Return the descriptor, whose width rich asks for."""
        return self._real.fileno()

    def write(self, text: str) -> int:
        """Write what can be written."""
        with suppress(OSError):
            self._real.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush what can be flushed."""
        with suppress(OSError):
            self._real.flush()


def stderr_console() -> Console:
    """Return a console on stderr: coloured on a terminal unless NO_COLOR is set, plain and unwrapped elsewhere."""
    plain = not sys.stderr.isatty() or bool(os.environ.get("NO_COLOR")) or os.environ.get("TERM") == "dumb"
    width = None if sys.stderr.isatty() else LINE
    file = cast(IO[str], _Stderr())
    return Console(file=file, stderr=True, no_color=plain, highlight=False, soft_wrap=True, width=width, emoji=False)


def emit_json(value: Mapping[str, Any]) -> None:
    """Write one JSON object to stdout."""
    sys.stdout.write(dump_json(value, indent=1) + "\n")
    sys.stdout.flush()


def emit(text: str) -> None:
    """Write a line of a result to stdout."""
    sys.stdout.write(text + "\n")


def show_error(error: HolocalError) -> None:
    """Write one message to stderr: what happened, why it matters, what to do."""
    console = stderr_console()
    console.print(f"[bold red]error[/] {escape(error.code)}: {escape(error.what)}")
    for part in (error.why, error.fix):
        if part:
            console.print(f"  {escape(part)}")


class Terminal:
    """The observer that a technician sees."""

    def __init__(self) -> None:
        self._console = stderr_console()
        live = self._console.is_terminal and not self._console.is_dumb_terminal
        self._status: Status | None = self._console.status("") if live else None
        self._header = False

    def __enter__(self) -> Terminal:
        if self._status is not None:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()

    def say(self, text: str, style: str = "") -> None:
        """Write a line."""
        self._console.print(escape(text), style=style or None)

    def preflight(self, checks: list[Check], seconds: float) -> None:
        """Write the pre-flight's sum, and each check that failed or warns."""
        failed, warned = ([item for item in checks if item.verdict == verdict] for verdict in ("fail", "warn"))
        passed = sum(item.verdict == "pass" for item in checks)
        unknown = sum(item.verdict == "unknown" for item in checks)
        more = f", {unknown} cannot be told here" if unknown else ""
        self.say(f"pre-flight  {passed} of {len(checks)} passed{more} in {seconds:.1f} s", "red" if failed else "")
        for item in (*failed, *warned):
            said = f"  {item.id} {item.title}: {item.measured} {item.unit}, limit {item.limit}. {item.remedy}"
            self.say(said, "red" if item in failed else "yellow")

    def waiting(self, what: str) -> None:
        """Say what the run waits for, where there is a terminal."""
        if self._status is not None:
            self._status.update(escape(f"{what} ..."))

    def counted(self, what: str) -> Callable[[int, int], None]:
        """Return what is told how many of how many pieces are done: a bar on a terminal, else a line each tenth."""
        began: list[tuple[float, int]] = []

        def said(done: int, of: int) -> None:
            now = time.monotonic()
            if not began:
                began.append((now, done))
            since, first = began[0]
            left = (now - since) * (of - done) / (done - first) if done > first else None
            text = f"{what} {done} of {of}" + ("" if left is None else f", {left:.0f} s left")
            if self._status is not None:
                filled = 24 * done // max(of, 1)
                self._status.update(escape(f"{'━' * filled}{'╌' * (24 - filled)} {text}"))
            elif done in (first, of) or 10 * done // of > 10 * (done - 1) // of:
                self.say(f"  {text}")

        return said

    def incident(self, sentence: str) -> None:
        """Write a bad frame or a halved exposure."""
        self.say(f"  ! {sentence}", "yellow")

    def step(self, number: int, progress: Mapping[str, Any], judgement: Judgement) -> None:
        """Write a step as a line of the table: the goal's number with its sigma, and the target."""
        quantity = str(progress.get("quantity", "value"))
        if not self._header:
            self._header = True
            self.say(f" step  {quantity:<28}  {'target':>9}  ", "bold")
        value = _with_sigma(progress.get("value"), progress.get("sigma"))
        met = judgement.outcome is Outcome.TARGET_MET
        text = f" {number:>4}  {value:<28}  {_number(progress.get('target')):>9}  {judgement.sentence}"
        self.say(text, "green" if met else "")


def _with_sigma(value: Any, sigma: Any) -> str:
    return _number(value) + (f" +- {_number(sigma)}" if sigma is not None else "")


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, (int, float)) else ("-" if value is None else str(value))
