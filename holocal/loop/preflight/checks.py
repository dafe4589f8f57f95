"""One line of the pre-flight, and what follows when one fails."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from holocal.errors import RefusedError
from holocal.loop.devices import Finding

PASS, WARN, FAIL, UNKNOWN = "pass", "warn", "fail", "unknown"


@dataclass(frozen=True)
class Check:
    """One line of the pre-flight.

    `verdict` is "pass", "warn" (go on, but know of it), "fail" (refused) or "unknown" (cannot be told on this rig,
    which refuses nothing); `remedy` says what to do when it is not "pass".
    """

    id: str
    title: str
    measured: float | str
    limit: float | str
    unit: str
    verdict: str
    remedy: str

    def as_json(self) -> dict[str, Any]:
        """Return the check as a JSON-ready dictionary."""
        return asdict(self)


def check(
    identifier: str,
    title: str,
    measured: float,
    limit: float,
    unit: str,
    remedy: str,
    *,
    at_least: bool = False,
    otherwise: str = FAIL,
) -> Check:
    """Return a check that passes when `measured` is at most (or `at_least`) `limit`; not a number does not pass."""
    passed = measured >= limit if at_least else measured <= limit
    return Check(identifier, title, measured, limit, unit, PASS if passed else otherwise, remedy)


def unknown(identifier: str, title: str, remedy: str) -> Check:
    """Return a check that this rig gives no way to make."""
    return Check(identifier, title, "not known", "", "", UNKNOWN, remedy)


def from_finding(identifier: str, device: str, finding: Finding) -> Check:
    """Return what a device says of its set-up as a check."""
    verdict = {True: PASS, False: FAIL, None: UNKNOWN}[finding.ok]
    title = f"{device}: {finding.title}"
    return Check(identifier, title, finding.measured, finding.limit, finding.unit, verdict, finding.remedy)


def failed(checks: Sequence[Check]) -> list[Check]:
    """Return the checks that refuse a run."""
    return [item for item in checks if item.verdict == FAIL]


def refuse_failed(checks: Sequence[Check]) -> None:
    """Raise `RefusedError` that names every failed check; do nothing when none failed."""
    found = failed(checks)
    if not found:
        return
    named = "; ".join(f"{item.id} {item.title}: {in_words(item)}" for item in found)
    times = Counter(item.id for item in found)
    keys = [item.id if times[item.id] == 1 else f"{item.id} {item.title}" for item in found]
    raise RefusedError(
        f"pre-flight: {len(found)} of {len(checks)} checks failed. {named}.",
        why="What is measured on such a bench is not a calibration.",
        fix=" ".join(item.remedy for item in found),
        measured={key: item.measured for key, item in zip(keys, found, strict=True)},
        limit={key: item.limit for key, item in zip(keys, found, strict=True)},
        code=found[0].id,
    )


def in_words(item: Check) -> str:
    """Return what was measured, and its limit or what was expected, as a phrase."""
    measured, limit = (f"{x:.4g}" if isinstance(x, float | int) else x for x in (item.measured, item.limit))
    named = "expected" if isinstance(item.limit, str) else "limit"
    return f"{measured} {item.unit}".rstrip() + (f" ({named} {limit})" if limit else "")
