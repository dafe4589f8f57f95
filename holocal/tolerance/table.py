"""The benches that were drawn, one to a line, as text."""

from __future__ import annotations

from math import isfinite
from typing import Any

from holocal.records.tolerance_model import Study
from holocal.tolerance.bench_error import METRICS, STAGES
from holocal.tolerance.cases import drawn, drawn_key
from holocal.tolerance.summary import Found
from holocal.tolerance.verdict import allowances, reason


def benches_csv(study: Study, seed: int, found: Found) -> str:
    """Return the table: freedoms, numbers of every stage, what explains them, and what is not met after correction.

    Nine digits; an empty cell is a number that cannot be told.
    """
    limits = study.tolerances.spec.limits()
    more = list(found["nominal"]["more"])
    head = ["bench", *(name for name, _, _ in study.tolerances.freedoms())]
    head += [f"{stage}_{name}" for stage in STAGES for name in METRICS] + more
    head += [f"{stage}_within" for stage in STAGES] + ["after_misses", "pose_misses"]
    lines = [",".join(head)]
    for index in range(study.benches):
        errors = found[drawn_key(index)]
        cells = [str(index), *(_cell(value) for value in drawn(study.tolerances, seed, index).tolist())]
        cells += [_cell(errors[stage][name]) for stage in STAGES for name in METRICS]
        cells += [_cell(errors["more"][name]) for name in more]
        missed = {
            stage: [reason(name, used) for name, used in allowances(errors, stage, limits).items() if used > 1]
            for stage in STAGES
        }
        cells += ["no" if missed[stage] else "yes" for stage in STAGES]
        cells += ["; ".join(dict.fromkeys(missed[stage])) for stage in STAGES[1:]]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    return "" if value is None or not isfinite(value) else f"{value:.9g}"
