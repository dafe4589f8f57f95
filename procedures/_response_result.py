"""The result of `response`: numbers, the table, and pictures of how it came about."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.fringes import UNKNOWN_RAD, Fringes
from holocal.estimate.response import phase_difference, rms
from holocal.loop.procedure import Conclusion, Figure

if TYPE_CHECKING:
    from procedures.response import State

Array = NDArray[np.float64]

CERTAIN = 3.0  # standard errors by which the finer rows' phases must be too small before crosstalk is spoken of
# A pixel that takes the share k from each neighbour shows rows of 3 with 1 - 3.4 k of the phase and rows of 2 with
# 1 - 4 k of it, borders of cells included: at k = 0.04 the ratio is 0.968 and the table 0.864 of the truth.
PER_CROSSTALK = 4.3
SHOWN_PIXELS = 3


@dataclass(frozen=True)
class TableError:
    """A table against phases measured afresh at `levels`: `difference_rad`, its rms and what noise adds to that."""

    levels: NDArray[np.int64]
    difference_rad: Array
    sigma_rad: Array
    rms_rad: float
    noise_rad: float

    @property
    def rms_sigma_rad(self) -> float:
        """The standard error of `rms_rad`: that of the rms of so many differences, one piston taken out."""
        return float(max(self.rms_rad, self.noise_rad) / np.sqrt(2 * max(len(self.levels) - 1, 1)))


def error_at(levels: NDArray[np.int64], table_rad: Array, measured_rad: Array, covariance: Array) -> TableError:
    """Return how far a table is from phases that were measured at some of its levels."""
    n = len(levels)
    centre = np.eye(n) - 1 / n
    sigma = np.sqrt(np.diag(centre @ covariance @ centre))
    difference = phase_difference(table_rad[levels], measured_rad)
    # One piston was fitted to n differences, hence n - 1.
    found, noise = (float(np.sqrt(np.sum(values**2) / (n - 1))) for values in (difference, sigma))
    return TableError(levels, difference, sigma, found, noise)


@dataclass(frozen=True)
class Verified:
    """The verification: `error` of the table at levels that it was not made from.

    `scale` is the factor between the phases seen through the finer rows and the table, `scale_sigma` its error;
    `crosstalk_rad` what the table is wrong by, rms, if that factor comes from neighbours that blur each other.
    """

    error: TableError
    scale: float
    scale_sigma: float
    crosstalk_rad: float
    valid: bool


def verified(state: State, fresh: Fringes) -> Verified:
    """Return how far the table is from the verification's phases, at the levels that it was not made from."""
    assert state.table is not None
    unseen = ~np.isin(fresh.levels, np.unique(state.shown))
    if np.count_nonzero(unseen) < 3:  # a panel of few levels: all were measured, and are now measured again
        unseen = np.ones(len(fresh.levels), np.bool_)
    levels, covariance = fresh.levels[unseen], fresh.covariance[np.ix_(unseen, unseen)]
    if not (fresh.valid and state.table.valid):
        unknown = np.full(len(levels), UNKNOWN_RAD)
        nothing = TableError(levels, np.zeros(len(levels)), unknown, UNKNOWN_RAD, UNKNOWN_RAD)
        return Verified(nothing, 1.0, float("inf"), 0.0, False)
    measured = fresh.phase_rad[unseen] * (-1.0 if state.rising is False else 1.0)
    error = error_at(levels, state.table.phase_rad, measured, covariance)
    expected = state.table.phase_rad[levels]
    x = expected - expected.mean()
    both = covariance + state.table.covariance[np.ix_(levels, levels)]
    scale = float(x @ (measured - measured.mean()) / (x @ x))
    scale_sigma = float(np.sqrt(x @ both @ x) / (x @ x))
    certain = 1 - scale > CERTAIN * scale_sigma
    crosstalk = PER_CROSSTALK * (1 - scale) * float(np.std(state.table.phase_rad)) if certain else 0.0
    return Verified(error, scale, scale_sigma, crosstalk, True)


def conclusion(state: State, fresh: Fringes) -> Conclusion:
    """Return the conclusion from the final state and the phases of the verification."""
    assert state.table is not None
    assert state.fringes is not None
    chosen, table, check = state.parameters, state.table, verified(state, fresh)
    before = rms(phase_difference(state.in_force, table.phase_rad)) if table.valid else UNKNOWN_RAD
    blurred = check.crosstalk_rad > chosen.target_rad
    met = check.valid and state.sign_known and check.error.rms_rad <= chosen.target_rad and not blurred
    error = check.error
    sentence = (
        f"phase error {before:.3f} -> {error.rms_rad:.4f} rad rms (target {chosen.target_rad:g}; the check's own noise "
        f"is {error.noise_rad:.4f}), range {table.range_rad / np.pi:.3f} pi, from {len(state.fringes.levels)} of "
        f"{state.count} levels: {'met' if met else 'not met'}"
    )
    if not check.valid:
        sentence = f"no phase response: {state.fringes.reason or fresh.reason or 'the verification shows no fringe'}"
    elif not state.sign_known:
        sentence += "; the pictures do not tell whether the phase rises or falls: give --set sign=rising or falling"
    if blurred:
        sentence += (
            f"; rows of 2 pixels give {check.scale:.4f} times the phase of rows of 3: neighbouring pixels blur each "
            f"other (crosstalk), and the table is wrong by about {check.crosstalk_rad:.3f} rad rms"
        )
    camera = state.facts.camera
    nothing = np.zeros((3, camera.height, camera.width), np.float32)
    pictures = nothing if state.pictures is None else state.pictures
    after_map = pictures[2 if state.rising is False else 1]
    phase = table.phase_rad.astype(np.float32)[None]
    return Conclusion(
        before={"phase_error_rms_rad": before, "range_rad": float(state.in_force[-1] - state.in_force[0])},
        after={"phase_error_rms_rad": error.rms_rad, "range_rad": table.range_rad if table.valid else None},
        targets={"phase_error_rms_rad": chosen.target_rad},
        targets_met=met,
        sentence=sentence,
        maps={"correction.phase_rad": phase, "correction.sigma_rad": table.sigma_rad.astype(np.float32)[None]},
        before_map=pictures[0],
        after_map=after_map,
        map_units={
            "correction.phase_rad": "rad",
            "correction.sigma_rad": "rad",
            "before": "counts/s",
            "after": "counts/s",
        },
        map_metadata={"axes": ("row", "level")},
        sigma=_sigma(state, check),
        extra=_extra(state, check),
        figures=_figures(state, check, pictures),
    )


def _sigma(state: State, check: Verified) -> dict[str, dict[str, float]]:
    table = state.table
    if table is None or not (table.valid and check.valid):
        return {}
    ends = np.zeros(state.count)
    ends[[0, -1]] = -1, 1
    return {
        "before": {"phase_error_rms_rad": table.sigma_rms_rad},
        "after": {
            "phase_error_rms_rad": check.error.rms_sigma_rad,
            "range_rad": float(np.sqrt(np.maximum(ends @ table.covariance @ ends, 0.0))),
        },
    }


def _extra(state: State, check: Verified) -> dict[str, Any]:
    assert state.table is not None
    assert state.fringes is not None
    fringes = state.fringes
    return {
        "wavelength_nm": state.parameters.wavelength_nm,
        "response": {
            "phase_rad": state.table.phase_rad.tolist(),
            "sigma_rad": state.table.sigma_rad.tolist(),
            "sigma_rms_rad": state.table.sigma_rms_rad,
            "valid": state.table.valid,
        },
        "fit": {
            "levels": len(fringes.levels),
            "pixels": int(np.count_nonzero(fringes.kept)),
            "chi2": fringes.chi2 if fringes.valid else None,
            "reason": fringes.reason,
        },
        "verification": {
            "levels": check.error.levels.tolist(),
            "difference_rad": check.error.difference_rad.tolist(),
            "noise_rms_rad": check.error.noise_rad,
        },
        "crosstalk": {
            "scale": check.scale,
            "sigma": check.scale_sigma if check.valid else None,
            "table_error_rad": check.crosstalk_rad,
        },
        "sign": {
            "rising": state.rising,
            "known": state.sign_known,
            "likeness": dict(zip(("before", "rising", "falling"), state.alike, strict=False)),
        },
        "exposure_s": state.exposure_s,
    }


def _figures(state: State, check: Verified, pictures: NDArray[np.float32]) -> tuple[Figure, ...]:
    """Return the report's pictures: the curve, its residual, the verification, some fringes, the picture."""
    assert state.table is not None
    assert state.fringes is not None
    table, fringes, error = state.table, state.fringes, check.error
    levels = np.arange(state.count)
    sign = -1.0 if state.rising is False else 1.0
    residual = phase_difference(sign * fringes.phase_rad, table.phase_rad[fringes.levels])
    return (
        Figure(
            "response",
            "Phase of each level",
            "curve",
            {"x": levels, "measured": table.phase_rad, "measured_sigma": table.sigma_rad, "in_force": state.in_force},
            "rad",
            "x: level. The band is the standard error; in force: what frames were made with until now.",
        ),
        Figure(
            "error",
            "What the table in force is wrong by",
            "curve",
            {"x": levels, "in_force": phase_difference(state.in_force, table.phase_rad), "sigma": table.sigma_rad},
            "rad",
            "x: level. Piston taken out.",
        ),
        Figure(
            "residual",
            "Measured phases against the table that was made from them",
            "curve",
            {"x": fringes.levels, "measured_less_table": residual, "sigma": fringes.sigma_rad},
            "rad",
            "x: level. The band is the standard error of a phase.",
        ),
        Figure(
            "verification",
            "The table against levels that it was not made from",
            "curve",
            {
                "x": error.levels,
                "table_less_measured": error.difference_rad,
                "sigma": error.sigma_rad,
            },
            "rad",
            "x: level. Another pattern, other pixels, fresh frames; the band is the noise of the check.",
            target=state.parameters.target_rad,
        ),
        _fringes(state),
        Figure(
            "picture",
            "A picture of blobs with the table in force, the measured one, and its negative",
            "pair",
            dict(zip(("before", "measured", "negative"), pictures, strict=True)),
            "counts/s",
            "The measured table and its negative tell the sign: the right one of the two is sharp.",
            _extent(state),
        ),
    )


def _extent(state: State) -> tuple[float, float, float, float]:
    half = [float(np.degrees(angle) / 2) for angle in state.facts.camera.field_rad]
    return -half[0], half[0], -half[1], half[1]


def _fringes(state: State) -> Figure:
    """Return the fringes of a few pixels, strong and unlike one another: counts against level, with their fit."""
    assert state.fringes is not None
    fringes, shown = state.fringes, np.asarray(state.shown)
    kept = np.flatnonzero(np.isfinite(state.light).all(axis=0))[fringes.kept] if fringes.valid else np.zeros(0, int)
    order = np.argsort(shown, kind="stable")
    arrays: dict[str, Array] = {"x": shown[order].astype(np.float64)}
    if kept.size:
        a, c, s = fringes.pixels[:, fringes.kept]
        swing, angle = np.hypot(c, s), np.arctan2(s, c)
        strong = swing >= np.quantile(swing, 0.9)
        phase = fringes.phase_rad[np.searchsorted(fringes.levels, shown)]
        for number in range(SHOWN_PIXELS):
            wanted = 2 * np.pi * number / SHOWN_PIXELS - np.pi
            near = np.where(strong, np.cos(angle - wanted), -2.0)
            one = int(np.argmax(near))
            fit = fringes.gains * (a[one] + c[one] * np.cos(phase) + s[one] * np.sin(phase))
            arrays[f"pixel_{number + 1}"] = state.light[order, kept[one]].astype(np.float64)
            arrays[f"pixel_{number + 1}_fit"] = fit[order]
    return Figure(
        "fringes", "Fringes of some camera pixels", "curve", arrays, "counts", "x: level. Each has its own phase."
    )
