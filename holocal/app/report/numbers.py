"""Numbers as they are read."""

from __future__ import annotations

from typing import Any


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
