"""What a study says: yields, how errors are spread, what drives them, and where correction no longer suffices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import inf, sqrt
from statistics import NormalDist
from typing import Any

import numpy as np
from scipy.optimize import brentq

from holocal.optics.bench import Array
from holocal.records.tolerance_model import Study, Tolerances
from holocal.tolerance.bench_error import METRICS, STAGES
from holocal.tolerance.cases import ALONE, SCALES, STEP, alone_key, drawn, drawn_key, scaled_key, step_key
from holocal.tolerance.verdict import SMALLEST, Errors, allowances, crossing, reason, within

PERCENTILES = (5, 50, 95)
DRIVEN = (
    "wavefront_median_rad",
    "distortion_rms_px",
    "light_fraction",
    "field_coverage",
)  # of which sensitivities are told
WORST = 10

Found = Mapping[str, Errors]


def summary(study: Study, seed: int, found: Found) -> dict[str, Any]:
    """Return the study's result, JSON-ready, from the errors of every case by its key."""
    limits = study.tolerances.spec.limits()
    benches = [found[drawn_key(index)] for index in range(study.benches)]
    stages = {stage: _stage(benches, found["nominal"], stage, limits) for stage in STAGES}
    critical = {stage: _critical_scales(study, found, stage, limits) for stage in STAGES}
    return {
        **stages,
        "nominal": found["nominal"],
        "targets": {**limits, "yield": study.tolerances.wanted_yield},
        "four_corners": {name: _spread([_number(one["more"][name]) for one in benches]) for name in _CORNERS},
        "scale": {stage: _scale(study, critical[stage]) for stage in STAGES},
        "freedoms": _freedoms(study, seed, found, benches, limits),
        "worst": _worst(study, seed, benches, limits),
    }


_CORNERS = ("corners_rms_px", "corners_max_px")


def _stage(benches: Sequence[Errors], nominal: Errors, stage: str, limits: Mapping[str, float]) -> dict[str, Any]:
    """Return a stage's yield with its error, by limit, what the drawing itself misses, and percentiles of numbers."""
    passed = sum(within(one, stage, limits) for one in benches)
    used = [allowances(one, stage, limits) for one in benches]
    spread = {
        name: _spread([_number(one[stage][name]) for one in benches], smallest=name in SMALLEST) for name in METRICS
    }
    by_limit = {name: sum(one[name] <= 1 for one in used) / len(used) for name in used[0]}
    return {
        "yield": passed / len(benches),
        "yield_interval": list(wilson(passed, len(benches))),
        **{name: spread[name][_bad(name)] for name in METRICS},
        "yield_by_limit": by_limit,
        "nominal_misses": [name for name, value in allowances(nominal, stage, limits).items() if value > 1],
        "failures": _failures(used),
        "spread": spread,
    }


def _failures(used: Sequence[Mapping[str, float]]) -> dict[str, int]:
    """Return how many benches fail for each reason; a bench may have several."""
    counted = Counter(why for one in used for why in {reason(name, value) for name, value in one.items() if value > 1})
    return dict(sorted(counted.items(), key=lambda item: (-item[1], item[0])))


def _bad(name: str) -> str:
    """Return which percentile of a number stands for the study: that of the worse benches."""
    return "p5" if name in SMALLEST else "p95"


def _spread(values: Sequence[float], *, smallest: bool = False) -> dict[str, float | None]:
    """Return percentiles of values; those that are not known count as worse than all others, and are counted.

    `smallest`: small values are the bad ones. A percentile that is not known is None.
    """
    known = np.isfinite(values)
    ranked = np.where(known, values, -np.inf if smallest else np.inf)
    numbers = np.percentile(ranked, PERCENTILES, method="lower" if smallest else "higher").tolist()
    told = {f"p{p}": v if np.isfinite(v) else None for p, v in zip(PERCENTILES, numbers, strict=True)}
    return {**told, "unknown": int(np.count_nonzero(~known))}


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def wilson(passed: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share of `count` (Wilson, doi:10.1080/01621459.1927.10502953)."""
    z = NormalDist().inv_cdf(0.975)
    share, spread = passed / count, z * z / count
    middle = (share + spread / 2) / (1 + spread)
    half = z * sqrt(share * (1 - share) / count + spread / (4 * count)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def _critical_scales(study: Study, found: Found, stage: str, limits: Mapping[str, float]) -> list[tuple[float, str]]:
    """Return for each bench that was scaled at which scale it first misses a limit, and which."""
    ladder = [0.0, *sorted({*SCALES, 1.0})]
    every = []
    for index in range(min(study.scaled, study.benches)):
        errors = [found["nominal"], *(found[scaled_key(scale, index)] for scale in ladder[1:])]
        every.append(crossing(ladder, errors, stage, limits))
    return every


def _scale(study: Study, critical: Sequence[tuple[float, str]]) -> dict[str, Any]:
    """Return the scale of all tolerances at which the yield falls to the wanted one, why, and the whole curve."""
    scales = np.sort([scale for scale, _ in critical])
    wanted = study.tolerances.wanted_yield
    kept = int(np.ceil(wanted * len(scales)))  # benches that must still be within
    at = float(scales[len(scales) - kept])
    first = Counter(why for scale, why in critical if np.isfinite(scale))
    return {
        "at_wanted_yield": at if np.isfinite(at) else None,
        "beyond_largest": not np.isfinite(at),
        "largest": max(SCALES),
        "first_missed": dict(first.most_common()),
        "critical": [scale if np.isfinite(scale) else None for scale in scales.tolist()],
    }


def _freedoms(
    study: Study, seed: int, found: Found, benches: Sequence[Errors], limits: Mapping[str, float]
) -> dict[str, Any]:
    """Return for each degree of freedom its sensitivities, its share of each error, and the tolerance it may have."""
    names = [name for name, _, _ in study.tolerances.freedoms()]
    widths = np.array([width for _, width, _ in study.tolerances.freedoms()])
    slopes = {name: np.array([_slope(found, k, name) for k in range(12)]) for name in DRIVEN}
    drawings: Array = np.stack([np.abs(drawn(study.tolerances, seed, k)) for k in range(study.benches)])
    made: dict[str, Any] = {}
    for k, freedom in enumerate(names):
        shares = {name: _share(slope * widths, k) for name, slope in slopes.items()}
        ranks = {
            name: _rank_correlation(drawings[:, k], np.array([_number(one["before"][name]) for one in benches]))
            for name in DRIVEN
        }
        made[freedom] = {
            "tolerance": float(widths[k]),
            "per_unit": {name: float(slope[k]) for name, slope in slopes.items()},
            "share": shares,
            "rank_correlation": ranks,
            "allowed": {stage: _allowed(study.tolerances, k, found, stage, limits) for stage in STAGES},
        }
    return made


def _slope(found: Found, freedom: int, name: str) -> float:
    """Return how much a number before correction changes per degree or millimetre, the mean of both sides."""
    own = _number(found["nominal"]["before"][name])
    both = [_number(found[step_key(freedom, sign)]["before"][name]) for sign in (1, -1)]
    return float(np.mean([abs(one - own) for one in both])) / STEP


def _share(contributions: Array, k: int) -> float:
    """Return the share of one of independent contributions in the sum of their squares."""
    total = float(np.sum(contributions**2))
    return float(contributions[k] ** 2) / total if total > 0 else 0.0


def _rank_correlation(x: Array, y: Array) -> float | None:
    """Return Spearman's rank correlation over the benches whose number is known; None of fewer than 3."""
    known = np.isfinite(y)
    if np.count_nonzero(known) < 3 or np.ptp(x[known]) == 0 or np.ptp(y[known]) == 0:
        return None
    ranks = [np.argsort(np.argsort(values[known], kind="stable"), kind="stable") for values in (x, y)]
    return float(np.asarray(np.corrcoef(ranks))[0, 1])


def _allowed(
    tolerances: Tolerances, k: int, found: Found, stage: str, limits: Mapping[str, float]
) -> dict[str, Any] | None:
    """Return the tolerance of a degree of freedom that is out alone at which the wanted yield is reached, and why.

    None where it has no tolerance. `tolerance` is None where even the largest displacement tried is within the spec.
    """
    _, width, law = list(tolerances.freedoms())[k]
    if not width:
        return None
    ladder = [0.0, *ALONE]
    ends = []
    for sign in (1, -1):
        errors = [found["nominal"], *(found[alone_key(k, sign * factor)] for factor in ALONE)]
        ends.append(crossing(ladder, errors, stage, limits))
    limit = width_for(min(ends)[0] * width, max(ends)[0] * width, law=law, share=tolerances.wanted_yield)
    return {
        "tolerance": limit if np.isfinite(limit) else None,
        "tried_to": max(ALONE) * width,
        "positive": ends[0][0] * width if np.isfinite(ends[0][0]) else None,
        "negative": -ends[1][0] * width if np.isfinite(ends[1][0]) else None,
        "why": min(ends)[1],
    }


def width_for(near: float, far: float, *, law: str, share: float) -> float:
    """Return the width of a distribution of which a share lies between -`near` and +`far` (>= near), or reversed.

    >>> round(width_for(1.0, 1.0, law="normal", share=0.95), 3)
    0.51
    >>> round(width_for(1.0, 1.0, law="uniform", share=0.95), 3)
    1.053
    """
    if near == 0 or not np.isfinite(near):
        return 0.0 if near == 0 else inf
    if law == "uniform":
        one_sided = far >= near / (2 * share - 1) if share > 0.5 else True
        return near / (2 * share - 1) if one_sided and share > 0.5 else (near + far) / (2 * share)
    normal = NormalDist()

    def excess(width: float) -> float:
        return normal.cdf(far / width if np.isfinite(far) else inf) - normal.cdf(-near / width) - share

    return float(brentq(excess, 1e-3 * near, 1e3 * near)) if excess(1e3 * near) < 0 else inf


def _worst(study: Study, seed: int, benches: Sequence[Errors], limits: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return the benches that use most of an allowance after correction, with why and their freedoms."""
    names = [name for name, _, _ in study.tolerances.freedoms()]
    ranked = []
    for index, one in enumerate(benches):
        used = allowances(one, "after", limits)
        worst = max(used, key=lambda name: used[name])
        ranked.append((used[worst], -index, worst))
    return [
        {
            "bench": -index,
            "why": reason(worst, used),
            "used": used if np.isfinite(used) else None,
            "freedoms": dict(zip(names, drawn(study.tolerances, seed, -index).tolist(), strict=True)),
            "errors": benches[-index],
        }
        for used, index, worst in sorted(ranked, reverse=True)[:WORST]
    ]
