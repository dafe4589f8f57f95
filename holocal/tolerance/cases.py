"""Which benches a study looks at: drawn, drawn and scaled, and with one degree of freedom out at a time.

A case is known by its key alone: the same key of the same study is the same bench, in whatever order and wherever it
is computed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from holocal.optics.bench import Array
from holocal.records.tolerance_model import Study, Tolerances

# Of all tolerances together. Between neighbours the numbers of a bench are taken for straight lines.
SCALES = (0.125, 0.25, 0.35, 0.5, 0.7, 1.4, 2.0, 2.8, 4.0, 8.0)
ALONE = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # of a degree of freedom's own tolerance
STEP = 0.05  # degrees or millimetres, of the finite differences: small against any tolerance, far above rounding


@dataclass(frozen=True)
class Case:
    """One bench of a study: `freedoms` (12,) in degrees and millimetres, in the order of `Tolerances.freedoms`."""

    key: str
    freedoms: tuple[float, ...]


def cases(study: Study, seed: int) -> Iterator[Case]:
    """Yield every case of a study: the drawing, the benches drawn, those scaled, and each freedom alone."""
    yield Case("nominal", (0.0,) * 12)
    widths = np.array([width for _, width, _ in study.tolerances.freedoms()])
    for index in range(study.benches):
        yield _case(drawn_key(index), drawn(study.tolerances, seed, index))
    for scale in SCALES:
        for index in range(min(study.scaled, study.benches)):
            yield _case(scaled_key(scale, index), scale * drawn(study.tolerances, seed, index))
    for freedom in range(12):
        axis = np.eye(12)[freedom]
        for sign in (1, -1):
            yield _case(step_key(freedom, sign), sign * STEP * axis)
            if widths[freedom]:
                for factor in ALONE:
                    yield _case(alone_key(freedom, sign * factor), sign * factor * widths * axis)


def drawn(tolerances: Tolerances, seed: int, index: int) -> Array:
    """Return the twelve freedoms (12,) of a bench, degrees and millimetres, from (seed, index) only."""
    rng = np.random.default_rng([seed, index])
    laws = {"normal": rng.standard_normal(12), "uniform": rng.uniform(-1.0, 1.0, 12)}
    return np.array([width * laws[law][i] for i, (_, width, law) in enumerate(tolerances.freedoms())])


def drawn_key(index: int) -> str:
    """Return the key of a bench that was drawn."""
    return f"bench/{index:06d}"


def scaled_key(scale: float, index: int) -> str:
    """Return the key of a bench that was drawn and scaled; at scale 1 it is the drawn one."""
    return drawn_key(index) if scale == 1.0 else f"scale/{scale:g}/{index:06d}"


def alone_key(freedom: int, factor: float) -> str:
    """Return the key of a bench with one degree of freedom at a multiple of its tolerance."""
    return f"alone/{freedom:02d}/{factor:+g}"


def step_key(freedom: int, sign: int) -> str:
    """Return the key of one side of a finite difference."""
    return f"step/{freedom:02d}/{sign:+d}"


def _case(key: str, freedoms: Array) -> Case:
    return Case(key, tuple(float(value) for value in freedoms))
