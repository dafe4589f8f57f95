"""The numbers of a result, flat: each with its standard error and its target."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

SIDES = ("before", "after")


@dataclass(frozen=True)
class Number:
    """A number of a result; `sigma` and `target` are None where nothing says them."""

    value: float
    sigma: float | None = None
    target: float | None = None

    @property
    def text(self) -> str:
        """The number as it is read, with its sigma."""
        return f"{self.value:.4g}" + ("" if self.sigma is None else f" +- {self.sigma:.2g}")


def numbers_of(result: Mapping[str, Any], side: str) -> dict[str, Number]:
    """Return the numbers of `before` or `after` by their keys, those of nested tables joined by ``_``.

    A table of a `mean` and a `sigma` is one number. Lists and texts are left out, and so is what is damaged.

    >>> numbers_of({"after": {"median": {"rms_rad": 0.1}}, "targets": {"median_rms_rad": 0.2}}, "after")
    {'median_rms_rad': Number(value=0.1, sigma=None, target=0.2)}
    """
    sigmas = _table(_table(result.get("sigma")).get(side))
    targets = _table(result.get("targets"))
    found = {}
    for name, (value, own) in _flat(_table(result.get(side))).items():
        sigma = own if own is not None else _finite(sigmas.get(name))
        found[name] = Number(value, sigma, _finite(targets.get(name)))
    return found


def main_number(result: Mapping[str, Any]) -> str | None:
    """Return the key of the number that a result is known by: the first that has a target, None when none has."""
    after = numbers_of(result, "after")
    return next((name for name in _table(result.get("targets")) if name in after), None)


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, tuple[float, float | None]]:
    found: dict[str, tuple[float, float | None]] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            mean = _finite(value.get("mean"))
            if mean is not None and "sigma" in value:
                found[name] = (mean, _finite(value["sigma"]))
            else:
                found |= _flat(value, f"{name}_")
        elif (number := _finite(value)) is not None:
            found[name] = (number, None)
    return found


def _finite(value: Any) -> float | None:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # a whole number beyond 1e308
        return None


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
