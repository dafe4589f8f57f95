"""Two runs of one procedure side by side: which numbers differ significantly, and in what else the runs differ."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from holocal.errors import InputError
from holocal.records.files import read_json, read_toml
from holocal.records.manifest import require_intact
from holocal.records.results import SIDES, Number, numbers_of

SIGNIFICANT = 3.0  # standard errors of a difference: chance exceeds them once in 370 numbers
TOLD = ("procedure", "seed", "device", "rig", "parameters", "corrections")  # of config.toml; origins are no difference


@dataclass(frozen=True)
class Pair:
    """A number of both runs; None where a run has it not."""

    side: str
    name: str
    one: Number | None
    other: Number | None

    @property
    def difference(self) -> float | None:
        """The second less the first."""
        return None if self.one is None or self.other is None else self.other.value - self.one.value

    @property
    def sigmas(self) -> float | None:
        """The difference over its standard error; None where no error is known."""
        difference = self.difference
        if difference is None or self.one is None or self.other is None:
            return None
        if self.one.sigma is None or self.other.sigma is None:
            return None
        spread = math.hypot(self.one.sigma, self.other.sigma)
        return difference / spread if spread > 0 else None

    @property
    def significant(self) -> bool | None:
        """Whether the difference is more than chance; None: it cannot be told."""
        if self.difference == 0:
            return False
        return None if self.sigmas is None else abs(self.sigmas) > SIGNIFICANT

    def as_json(self) -> dict[str, Any]:
        """Return the pair, JSON-ready."""
        both = [None if n is None else {"value": n.value, "sigma": n.sigma} for n in (self.one, self.other)]
        said = {"difference": self.difference, "sigmas": self.sigmas, "significant": self.significant}
        return {"side": self.side, "name": self.name, "runs": both, **said}


@dataclass(frozen=True)
class Comparison:
    """Two runs: their numbers, and the fields that differ by where they stand: name -> both values."""

    runs: tuple[str, str]
    procedure: str
    pairs: tuple[Pair, ...]
    differences: Mapping[str, Mapping[str, tuple[Any, Any]]]

    def as_json(self) -> dict[str, Any]:
        """Return the comparison, JSON-ready."""
        return {
            "schema": 1,
            "runs": list(self.runs),
            "procedure": self.procedure,
            "limit_sigmas": SIGNIFICANT,
            "numbers": [pair.as_json() for pair in self.pairs],
            "differences": {
                where: {name: list(values) for name, values in fields.items()}
                for where, fields in self.differences.items()
            },
        }


def compare(one: Path, other: Path) -> Comparison:
    """Return two finished runs side by side.

    Raises
    ------
    InputError
        A run is damaged or has no result, or the two are of different procedures.
    """
    results = [_result(run) for run in (one, other)]
    procedures = [str(result.get("procedure")) for result in results]
    if procedures[0] != procedures[1]:
        raise InputError(
            f"{one.name} is of {procedures[0]}, {other.name} of {procedures[1]}.",
            why="Their numbers mean different things.",
            fix="Compare runs of one procedure; `holocal history` lists them.",
            measured=procedures[1],
            limit=procedures[0],
            code="other-procedure",
        )
    pairs: list[Pair] = []
    for side in SIDES:
        numbers = [numbers_of(result, side) for result in results]
        names = dict.fromkeys([*numbers[0], *numbers[1]])
        pairs += [Pair(side, name, numbers[0].get(name), numbers[1].get(name)) for name in names]
    files = {"configuration": _configuration, "identity": _identity, "environment": _environment}
    differences = {where: _differing(read(one), read(other)) for where, read in files.items()}
    differences["targets"] = _differing(results[0].get("targets", {}), results[1].get("targets", {}))
    return Comparison((str(one), str(other)), procedures[0], tuple(pairs), differences)


def lines(found: Comparison) -> Iterator[str]:
    """Yield the comparison as lines of text."""
    yield f"{found.procedure}: {Path(found.runs[0]).name}  against  {Path(found.runs[1]).name}"
    for side in SIDES:
        for pair in (pair for pair in found.pairs if pair.side == side):
            one, other = ("-" if number is None else number.text for number in (pair.one, pair.other))
            yield f"  {side:<6}  {pair.name:<28} {one:>22}   {other:>22}   {_verdict(pair)}"
    for where, fields in found.differences.items():
        for name, (one, other) in fields.items():
            yield f"  {where}: {name} = {_short(one)} | {_short(other)}"
    if not any(found.differences.values()):
        yield "  configuration, identity and environment are the same"


def _verdict(pair: Pair) -> str:
    if pair.difference is None:
        return "only one run has it"
    if pair.significant is None:
        return f"{pair.difference:+.4g}, not known whether by chance: no standard error"
    if pair.sigmas is None:
        return "the same"
    word = "differs" if pair.significant else "no significant difference"
    return f"{word}: {pair.difference:+.2g}, {abs(pair.sigmas):.1f} sigma (limit {SIGNIFICANT:g})"


def _result(run: Path) -> dict[str, Any]:
    require_intact(run)
    if not (run / "result.json").is_file():
        raise InputError(f"{run.name} has no result.", fix=f"`holocal report {run}` says why.", code="no-result")
    return read_json(run / "result.json")


def _configuration(run: Path) -> dict[str, Any]:
    config = read_toml(run / "config.toml")
    return {key: config[key] for key in TOLD if key in config}


def _identity(run: Path) -> dict[str, Any]:
    return read_json(run / "identity.json")


def _environment(run: Path) -> dict[str, Any]:
    return read_json(run / "environment.json")


def _differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    left, right = dict(_fields(one)), dict(_fields(other))
    names = sorted({*left, *right})
    return {name: (left.get(name), right.get(name)) for name in names if left.get(name) != right.get(name)}


def _fields(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _fields(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _short(value: Any) -> str:
    text = "-" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
