"""A bench against the spec: how much of each allowance it uses, which is used up first, and what that means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isfinite
from typing import Any

from holocal.tolerance.bench_error import STAGES

SMALLEST = ("light_fraction", "field_coverage")  # the limits that are least values

# What a limit that is not met after correction means: why correction by hologram does not suffice.
REASONS = {
    "wavefront_median_rad": "wavefront left",
    "wavefront_worst_rad": "wavefront left",
    "distortion_rms_px": "distortion left",
    "distortion_max_px": "distortion left",
    "nonuniformity_rms": "unevenness left",
    "light_fraction": "light lost",
    "field_coverage": "field not covered by the panel",
    "nyquist_use": "steeper than the panel's Nyquist frequency",
}
UNSEEN = "too little of the field seen to correct it"

Errors = Mapping[str, Mapping[str, Any]]


def allowances(errors: Errors, stage: str, limits: Mapping[str, float]) -> dict[str, float]:
    """Return how much of each allowance a bench uses at a stage: 0 perfect, 1 the limit, infinite what is not known.

    The panel's highest frequency is no matter of the uncorrected picture.
    """
    found = {}
    for name, limit in limits.items():
        if name == "nyquist_use" and stage == STAGES[0]:
            continue
        value = errors["more"][name] if name == "nyquist_use" else errors[stage][name]
        found[name] = _used(name, value, limit)
    return found


def _used(name: str, value: float | None, limit: float) -> float:
    if value is None or not isfinite(value):
        return inf
    if name not in SMALLEST:
        return value / limit
    return (1 - value) / (1 - limit) if limit < 1 else (0.0 if value >= 1 else inf)


def reason(name: str, used: float) -> str:
    """Return what an allowance that is used up means; one that cannot be told is that of a bench in the dark."""
    return REASONS[name] if isfinite(used) else UNSEEN


def within(errors: Errors, stage: str, limits: Mapping[str, float]) -> bool:
    """Return whether a bench meets every limit at a stage."""
    return all(used <= 1 for used in allowances(errors, stage, limits).values())


def crossing(
    factors: Sequence[float], errors: Sequence[Errors], stage: str, limits: Mapping[str, float]
) -> tuple[float, str]:
    """Return at which factor (ascending, the first 0) a bench first misses a limit, and the reason.

    Between two factors each allowance is taken for a straight line. (infinity, "") where it meets all to the end.
    """
    used = [allowances(one, stage, limits) for one in errors]
    for k, now in enumerate(used):
        missed = {name: value for name, value in now.items() if value > 1}
        if not missed:
            continue
        if k == 0:
            worst = max(missed, key=lambda name: missed[name])
            return 0.0, reason(worst, missed[worst])
        places = {name: _place(used[k - 1][name], value) for name, value in missed.items()}
        first = min(places, key=lambda name: places[name])
        return factors[k - 1] + places[first] * (factors[k] - factors[k - 1]), reason(first, missed[first])
    return inf, ""


def _place(low: float, high: float) -> float:
    """Return where between 0 and 1 a line from `low` <= 1 to `high` > 1 passes 1; the middle for one without end."""
    return (1 - low) / (high - low) if isfinite(high) else 0.5
