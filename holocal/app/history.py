"""The runs and checks of a rig in time: verdict, numbers before and after, and what is in force."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from holocal.errors import InputError
from holocal.records import calibration, index
from holocal.records.checks import checks_of
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
class Check:
    """What `holocal check` found of one procedure's accepted run."""

    utc: str
    procedure: str
    entry: str
    verdict: str
    sentence: str
    numbers: dict[str, dict[str, float | None]]

    @property
    def main(self) -> tuple[str, Number] | None:
        """The first number that was measured again, with its limit as target."""
        for name, said in self.numbers.items():
            found = numbers_of({"after": {name: said.get("value")}, "targets": {name: said.get("limit")}}, "after")
            sigma = said.get("sigma")
            if name in found:
                return name, replace(found[name], sigma=float(sigma) if isinstance(sigma, (int, float)) else None)
        return None


@dataclass(frozen=True)
class History:
    """What is known of a rig: its runs and checks, oldest first, and the run per procedure that is in force."""

    rig: str
    lines: tuple[Line, ...]
    checks: tuple[Check, ...]
    accepted: dict[str, str]
    rigs: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return everything, JSON-ready."""
        runs = [line.as_json() for line in self.lines]
        checks = [asdict(one) for one in self.checks]
        return {"schema": 1, "rig": self.rig, "accepted": self.accepted, "runs": runs, "checks": checks}


def history_of(rig: str, runs: Path, procedure: str | None = None) -> History:
    """Return the history of a rig, of the runs in `runs` and of all that were made elsewhere."""
    accepted = calibration.in_force(rig)
    before = _once_accepted(rig)
    with index.opened(runs) as known:
        found, rigs = known.runs(rig, procedure), known.rigs()
    lines = [Line(run, _standing(run.name, accepted, before)) for run in found]
    checks = tuple(one for one in _checks(rig) if procedure in (None, one.procedure))
    return History(rig, tuple(lines), checks, accepted, tuple(rigs))


def rig_name(rig: str) -> str:
    """Return the name that runs of a rig bear: that of its file, which need not exist any more."""
    path = Path(rig)
    return path.stem if path.suffix == ".toml" else rig


def table(history: History) -> list[str]:
    """Return the history as lines of text."""
    said = [f"in force for {history.rig}: " + (", ".join(f"{k} = {v}" for k, v in history.accepted.items()) or "none")]
    if not history.lines and not history.checks:
        return [*said, "no runs are known"]
    timed = [(line.run.utc, _text(line)) for line in history.lines]
    timed += [(check.utc, _text_of_check(check)) for check in history.checks]
    return [*said, *(text for _, text in sorted(timed, key=lambda one: one[0]))]


def _text_of_check(check: Check) -> str:
    said = f"  {check.utc:<20}  {check.procedure:<11} {check.verdict:<11}"
    if check.main is None:
        return f"{said} {'':<58} check of {check.entry}"
    name, now = check.main
    limit = "" if now.target is None else f" (limit {now.target:.4g})"
    return f"{said} {f'{name} {now.text}{limit}':<58} check of {check.entry}"


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


def _checks(rig: str) -> list[Check]:
    """Return the checks of a rig, one per procedure that was checked; what is damaged of them is left out."""
    found = []
    for said in checks_of(rig):
        for one in said["checked"]:
            texts = [str(one.get(key, "")) for key in ("procedure", "entry", "verdict", "sentence")]
            given = one.get("numbers")
            known = given.items() if isinstance(given, dict) else ()
            numbers = {str(name): dict(value) for name, value in known if isinstance(value, dict)}
            found.append(Check(said["utc"], texts[0], texts[1], texts[2], texts[3], numbers))
    return found


def _standing(run: str, accepted: dict[str, str], before: set[str]) -> str:
    if _among(run, set(accepted.values())):
        return IN_FORCE
    return BEFORE if _among(run, before) else ""


def _among(run: str, entries: set[str]) -> bool:
    """Return whether a run was accepted, or a part of it."""
    return any(entry == run or entry.startswith(f"{run}.") for entry in entries)


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
