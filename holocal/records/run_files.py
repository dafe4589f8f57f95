"""What a run directory says of itself, read without trust: what is missing, cut short or no file is left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from holocal.errors import HolocalError
from holocal.records.files import read_json, read_toml
from holocal.records.manifest import NAME as MANIFEST

RUN_TIME = "%Y%m%dT%H%M%SZ"  # of a run directory's name
LARGEST_BYTES = 64 * 2**20  # of a file that is read for its numbers: a result of 15 x 15 zones is 0.6 MB
STAMPED = (MANIFEST, "result.json", "identity.json")
KEPT = (
    "targets_met", "sentence", "frames", "seconds", "seed", "before", "after", "sigma", "targets", "corrections",
)  # fmt: skip
UNFINISHED = "unfinished"


@dataclass(frozen=True)
class RunSummary:
    """A run: where it lies, on which rig, how it ended, and the numbers of its ``result.json`` (empty when none)."""

    name: str
    path: str
    rig: str
    procedure: str
    utc: str
    status: str
    result: Mapping[str, Any]

    @property
    def verdict(self) -> str:
        """How it ended, in a word or two."""
        if self.status not in ("complete", "accepted"):
            return self.status
        return "met" if self.result.get("targets_met") is True else "not met"


def stamp_of(run: Path) -> str:
    """Return what changes when a run's files do: sizes and times of those that `summary_of` reads."""
    parts = []
    for name in STAMPED:
        try:
            found = (run / name).lstat()
            parts.append(f"{found.st_mtime_ns}.{found.st_size}")
        except OSError:
            parts.append("-")
    return " ".join(parts)


def is_run(directory: Path) -> bool:
    """Return whether a directory looks like a run, or like one that was accepted."""
    try:
        return any((directory / name).is_file() for name in (MANIFEST, "config.toml", "identity.json"))
    except OSError:
        return False


def summary_of(run: Path, *, accepted: bool = False) -> RunSummary:
    """Return what a run directory says of itself, however damaged it is."""
    result, identity, config = _json(run / "result.json"), _json(run / "identity.json"), _toml(run / "config.toml")
    table = config.get("rig")
    rig = identity.get("rig") or result.get("rig") or (table.get("name") if isinstance(table, Mapping) else None)
    procedure = result.get("procedure") or config.get("procedure") or _procedure_in(run.name)
    status = "accepted" if accepted else _json(run / MANIFEST).get("status") or UNFINISHED
    told = {key: _without_lists(result[key]) for key in KEPT if key in result}
    return RunSummary(
        name=run.name,
        path=str(run),
        rig=_printable(rig or ""),
        procedure=_printable(procedure),
        utc=utc_of(run.name),
        status=_printable(status),
        result=told,
    )


def part_summaries(run: Path, summary: RunSummary) -> list[RunSummary]:
    """Return what each procedure of a run of several says of itself, under the name that it is accepted by."""
    found = []
    for name, part in parts_of(run).items():
        own = summary_of(part)
        found.append(replace(own, name=part_entry(run.name, name), utc=summary.utc, status=summary.status))
    return found


def utc_of(name: str) -> str:
    """Return when a run was begun by its name, ISO 8601; "" for another name."""
    time = begun(name)
    return "" if time is None else time.strftime("%Y-%m-%dT%H:%M:%SZ")


def begun(name: str) -> datetime | None:
    """Return when a run was begun by the name of its directory; None for another name."""
    try:
        return datetime.strptime(name.partition("-")[0], RUN_TIME).replace(tzinfo=UTC)
    except ValueError:
        return None


def _printable(value: Any) -> str:
    """Return a text that any file and terminal takes: half a surrogate pair is a JSON string too."""
    return "".join(letter if letter.isprintable() else "?" for letter in str(value))


def part_entry(run: str, part: str) -> str:
    """Return the name that one procedure's result of a run of several has among accepted runs."""
    return f"{run}.{part}"


def parts_of(run: Path) -> dict[str, Path]:
    """Return the directories of the results of a run of several procedures, by their procedures; {} of another run."""
    listed = _json(run / "result.json").get("parts")
    names = [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []
    found = {name: run / name for name in names if name.isidentifier()}
    return {name: path for name, path in found.items() if path.is_dir() and not path.is_symlink()}


def _procedure_in(name: str) -> str:
    return "-".join(name.split("-")[1:-1])


def _without_lists(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_lists(item) for key, item in value.items() if not isinstance(item, list)}
    return value


def _json(path: Path) -> dict[str, Any]:
    try:
        return read_json(path) if _readable(path) else {}
    except HolocalError:
        return {}


def _toml(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path) if _readable(path) else {}
    except HolocalError:
        return {}


def _readable(path: Path) -> bool:
    """Return whether a file is the run's own and of a sensible size; a link may lead anywhere."""
    try:
        return not path.is_symlink() and path.is_file() and path.stat().st_size <= LARGEST_BYTES
    except OSError:
        return False
