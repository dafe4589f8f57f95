"""A bench in a process of its own, started and ended from Python."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

END_S = 20.0


@dataclass
class BenchProcess:
    """A running bench; `said` is the line with which it said that it serves."""

    process: subprocess.Popen[str] = field(repr=False)
    said: str

    def kill(self) -> None:
        """End it as a power cut would: nothing is switched off, nothing is said."""
        self.process.kill()
        self.stop()

    def stop(self) -> int:
        """End it and return its exit status; safe to call twice."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()  # it ends with the pipe
        status = self.process.wait(END_S)
        self.process.stdout.close()
        return status


def start(*arguments: str) -> BenchProcess:
    """Return a bench started with the arguments of ``python -m rigs.bench``, once it serves."""
    command = [sys.executable, "-m", "rigs.bench", *arguments]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    said = process.stdout.readline().strip()
    if not said.startswith("ready"):
        raise RuntimeError(f"{' '.join(command)} ended with {process.wait(END_S)}; see its words above")
    return BenchProcess(process, said)


@contextmanager
def running(arguments: Sequence[str]) -> Iterator[BenchProcess]:
    """Run a bench until the block ends."""
    bench = start(*arguments)
    try:
        yield bench
    finally:
        bench.stop()
