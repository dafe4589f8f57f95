"""Numbers as they are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from holocal.records.results import numbers_of


def number(value: Any) -> str:
    """Return a number with four digits, a truth value as yes or no, words as they are.

    >>> number(0.0123456), number(True), number(None), number([1, 2.5])
    ('0.01235', 'yes', 'not known', '1, 2.5')
    """
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "not known"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(item) for item in value)
    return str(value)


def goals(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the numbers of a result side by side, a row each: name, before, after, target; None is not known."""
    before, after = (numbers_of(result, side) for side in ("before", "after"))
    unknown = [name for name, value in result["after"].items() if value is None]
    return [
        {
            "name": name,
            "before": before[name].value if name in before else None,
            "after": after[name].value if name in after else None,
            "target": result["targets"].get(name),
        }
        for name in dict.fromkeys([*before, *after, *unknown])
    ]
