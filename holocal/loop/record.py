"""The run directory: opened before the first frame, whole at every moment, closed by its manifest.

The journal's line of a step is written before the checkpoint that vouches for it, and a resumed run cuts the journal
back to its checkpoint: no step is missing from it and none is there twice.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError, RefusedError
from holocal.loop.checkpoint import Progress, read_checkpoint, write_checkpoint
from holocal.loop.environment import environment
from holocal.loop.figures import write_figures
from holocal.loop.lock import locked
from holocal.loop.procedure import Conclusion
from holocal.records.files import (
    dump_json,
    dump_toml,
    make_directory,
    read_json,
    read_toml,
    storage_error,
    write_bytes,
    write_json,
)
from holocal.records.frames import write_counts
from holocal.records.manifest import NAME as MANIFEST
from holocal.records.manifest import write_manifest
from holocal.records.maps import write_maps
from holocal.records.run_files import RUN_TIME

LETTERS = "abcdefghijkmnpqrstuvwxyz23456789"  # none that are mistaken for each other
LOGGER = logging.getLogger("holocal")
MOST_BAD_FRAMES = 16  # kept of those that tripped a gate: 1.1 MB each


class RunRecord:
    """A run directory that is being written. Use `create` or `reopen`, then ``with record.open():``."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.opening: list[tuple[str, dict[str, Any]]] = []  # journal lines of how this sitting began
        self._bad_frames = 0

    @classmethod
    def create(cls, runs: Path, procedure: str, *, config: str, identity: Mapping[str, Any]) -> RunRecord:
        """Return a record in a new directory ``<runs>/<UTC>-<procedure>-<4 letters>``."""
        now = datetime.now(UTC).strftime(RUN_TIME)
        letters = "".join(secrets.choice(LETTERS) for _ in range(4))
        directory = make_directory(runs / f"{now}-{procedure}-{letters}")
        record = cls(directory.resolve())
        write_bytes(record.directory / "config.toml", config.encode())
        write_json(record.directory / "identity.json", identity)
        write_json(record.directory / "environment.json", environment())
        return record

    @classmethod
    def reopen(cls, directory: Path) -> RunRecord:
        """Return the record of a run that can go on; `InputError` when it is none or is complete."""
        if not (directory / "config.toml").is_file():
            raise InputError(
                f"{directory} is not a run directory: it has no config.toml.", fix="Give the path of a run."
            )
        manifest = directory / MANIFEST
        if manifest.is_file() and read_json(manifest).get("status") == "complete":
            raise InputError(f"{directory.name} is complete.", fix=f"Look at it: `holocal show {directory}`.")
        return cls(directory.resolve())

    @contextmanager
    def open(self) -> Iterator[RunRecord]:
        """Lock the directory, remove what a killed run left half done, and keep its log while open."""
        with locked(self.directory / ".lock", f"run {self.directory.name}"):
            for path in self.directory.rglob(".*.tmp*"):
                path.unlink(missing_ok=True)
            (self.directory / MANIFEST).unlink(missing_ok=True)
            try:
                handler = logging.FileHandler(self.directory / "log.txt", encoding="utf-8")
            except OSError as error:
                raise storage_error(error, self.directory / "log.txt") from error
            handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
            level = LOGGER.level
            LOGGER.setLevel(logging.INFO)
            LOGGER.addHandler(handler)
            try:
                yield self
            finally:
                LOGGER.removeHandler(handler)
                LOGGER.setLevel(level)
                handler.close()

    def config(self) -> dict[str, Any]:
        """Return the resolved configuration that the run was started with."""
        return read_toml(self.directory / "config.toml")

    def check_identity(self, identity: Mapping[str, Any]) -> None:
        """Raise `RefusedError` when the rig is not the one that the run was started on."""
        started = read_json(self.directory / "identity.json")
        for key in sorted({*started, *identity}):
            if started.get(key) != identity.get(key):
                raise RefusedError(
                    f"{self.directory.name} was started with {key} = {started.get(key)!r}; "
                    f"the rig now has {identity.get(key)!r}.",
                    why="A run must end on the bench that it began on.",
                    fix="Put the bench back, or start a new run.",
                    measured=identity.get(key),
                    limit=started.get(key),
                    code="other-rig",
                )

    def journal(self, event: str, **values: Any) -> None:
        """Add a line to ``events.jsonl`` and have it reach the disk."""
        stamp = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = dump_json({"event": event, "utc": stamp, **values}, indent=None) + "\n"
        path = self.directory / "events.jsonl"
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise storage_error(error, path) from error

    def checkpoint(self, state: Any, *, step: int, frames: int, seconds: float) -> None:
        """Write the state of a finished step; its journal line must be there already."""
        path = self.directory / "events.jsonl"
        size = path.stat().st_size if path.is_file() else 0
        write_checkpoint(self.directory, state, Progress(step, frames, seconds, size))

    def resume(self) -> tuple[Any, Progress] | None:
        """Return the last state that was vouched for, after cutting the journal back to it; None to start afresh."""
        found = read_checkpoint(self.directory)
        path = self.directory / "events.jsonl"
        if path.is_file():
            keep = found[1].journal_bytes if found else 0
            write_bytes(path, path.read_bytes()[:keep])
        return found

    def keep_frame(self, name: str, counts: NDArray[np.uint16]) -> str:
        """Write a frame that the report cites to ``frames/`` and return its relative name."""
        safe = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
        make_directory(self.directory / "frames")
        write_counts(self.directory / "frames" / f"{safe}.png", counts)
        return f"frames/{safe}.png"

    def keep_bad_frame(self, name: str, counts: NDArray[np.uint16]) -> str | None:
        """Write a frame that tripped a gate, up to a number of them; None when it cannot be kept."""
        if self._bad_frames >= MOST_BAD_FRAMES or counts.ndim != 2 or counts.size == 0:
            return None
        self._bad_frames += 1
        return self.keep_frame(name, np.clip(np.nan_to_num(counts), 0, 65535).astype(np.uint16))

    def preflight(self, checks: list[dict[str, Any]], *, frames: int) -> None:
        """Write ``preflight.json``."""
        write_json(self.directory / "preflight.json", {"schema": 1, "frames": frames, "checks": checks})

    def conclusion(self, conclusion: Conclusion, result: Mapping[str, Any]) -> None:
        """Write the maps, the figures and ``result.json``."""
        self._write_maps(self.directory, conclusion)
        write_figures(self.directory, conclusion.figures)
        write_json(self.directory / "result.json", result)

    def part(self, name: str, conclusion: Conclusion, result: Mapping[str, Any]) -> None:
        """Write one procedure's result of a run of several to a directory of its own, complete for `accept`."""
        directory = make_directory(self.directory / name)
        config = self.config()
        own = {**config, "procedure": name, "parameters": config.get("parameters", {}).get(name, {})}
        own.pop("origins", None)
        write_bytes(directory / "config.toml", dump_toml(own).encode())
        write_json(directory / "identity.json", read_json(self.directory / "identity.json"))
        self._write_maps(directory, conclusion)
        write_json(directory / "result.json", result)

    def _write_maps(self, directory: Path, conclusion: Conclusion) -> None:
        shared = {"extent_deg": conclusion.extent_deg, "run": self.directory.name, **conclusion.map_metadata}
        units = dict(conclusion.map_units)
        for name, picture in (("before", conclusion.before_map), ("after", conclusion.after_map)):
            write_maps(
                directory / f"{name}.exr", {"value": picture}, units={"value": units.get(name, "")}, metadata=shared
            )
        if conclusion.maps:
            write_maps(directory / "maps.exr", conclusion.maps, units=units, metadata=shared)

    def finish(
        self, status: str, *, render: Callable[[Path], bytes] | None, error: Mapping[str, Any] | None = None
    ) -> None:
        """Write the report and then, last, the manifest."""
        if error is not None:
            write_json(self.directory / "error.json", error)
        else:
            (self.directory / "error.json").unlink(missing_ok=True)
        if render is not None:
            write_bytes(self.directory / "report.html", render(self.directory))
        for handler in LOGGER.handlers:
            handler.flush()
        write_manifest(self.directory, status, error=error)


def read_journal(directory: Path) -> list[dict[str, Any]]:
    """Return the lines of a run's journal, up to the first that is torn."""
    path = directory / "events.jsonl"
    if not path.is_file():
        return []
    lines = []
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            break
        if not isinstance(line, dict) or "event" not in line:
            break
        lines.append(line)
    return lines
