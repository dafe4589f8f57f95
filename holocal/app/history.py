"""The runs and checks of a rig in time: verdict, numbers before and after, and what is in force."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from holocal.errors import InputError
from holocal.records import calibration, index
from holocal.records.files import read_json
from holocal.records.results import Number, main_number, numbers_of
from holocal.records.run_files import RunSummary

IN_FORCE, BEFORE = "in force", "before"


@dataclass(frozen=True)
class Line:
    """A run with how it stands: `accepted` is "in force", "before" (it was once) or ""."""

    run: RunSummary
    accepted: str

    @property
    def main(self) -> tuple[str, Number | None, Number] | None:
        """The number that the run is known by, before and after; None when it found none."""
        name = main_number(self.run.result)
        if name is None:
            return None
        return name, numbers_of(self.run.result, "before").get(name), numbers_of(self.run.result, "after")[name]

    def as_json(self) -> dict[str, Any]:
        """Return the line, JSON-ready."""
        run = self.run
        sides = {
            side: {name: {"value": one.value, "sigma": one.sigma} for name, one in numbers_of(run.result, side).items()}
            for side in ("before", "after")
        }
        return {
            "run": run.path,
            "procedure": run.procedure,
            "utc": run.utc,
            "status": run.status,
            "verdict": run.verdict,
            "accepted": self.accepted or None,
            **sides,
            "targets": run.result.get("targets", {}),
            "sentence": run.result.get("sentence"),
        }


@dataclass(frozen=True)
class History:
    """What is known of a rig: its runs, oldest first, and the run per procedure that is in force."""

    rig: str
    lines: tuple[Line, ...]
    accepted: dict[str, str]
    rigs: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return everything, JSON-ready."""
        runs = [line.as_json() for line in self.lines]
        return {"schema": 1, "rig": self.rig, "accepted": self.accepted, "runs": runs}


def history_of(rig: str, runs: Path, procedure: str | None = None) -> History:
    """Return the history of a rig, of the runs in `runs` and of all that were made elsewhere."""
    accepted = calibration.in_force(rig)
    before = _once_accepted(rig)
    with index.opened(runs) as known:
        found, rigs = known.runs(rig, procedure), known.rigs()
    lines = [Line(run, _standing(run.name, accepted, before)) for run in found]
    return History(rig, tuple(lines), accepted, tuple(rigs))


def rig_name(rig: str) -> str:
    """Return the name that runs of a rig bear: that of its file, which need not exist any more."""
    path = Path(rig)
    return path.stem if path.suffix == ".toml" else rig


def table(history: History) -> list[str]:
    """Return the history as lines of text."""
    said = [f"in force for {history.rig}: " + (", ".join(f"{k} = {v}" for k, v in history.accepted.items()) or "none")]
    if not history.lines:
        return [*said, "no runs are known"]
    return [*said, *(_text(line) for line in history.lines)]


def _text(line: Line) -> str:
    run = line.run
    mark = {IN_FORCE: "*", BEFORE: "+"}.get(line.accepted, " ")
    said = f"{mark} {run.utc or '-':<20}  {run.procedure:<11} {run.verdict:<11}"
    if line.main is None:
        return f"{said} {'':<58} {run.name}"
    name, before, after = line.main
    first = "-" if before is None else f"{before.value:.4g}"
    target = "" if after.target is None else f" (target {after.target:.4g})"
    return f"{said} {f'{name} {first} -> {after.text}{target}':<58} {run.name}"


def _standing(run: str, accepted: dict[str, str], before: set[str]) -> str:
    if run in accepted.values():
        return IN_FORCE
    return BEFORE if run in before else ""


def _once_accepted(rig: str) -> set[str]:
    """Return the runs that were ever in force; a damaged state tells nothing."""
    found: set[str] = set()
    for state in sorted((calibration.rig_directory(rig) / "states").glob("*.json")):
        try:
            accepted = read_json(state).get("accepted", {})
        except InputError:
            continue
        found |= {str(entry) for entry in accepted.values()} if isinstance(accepted, dict) else set()
    return found
