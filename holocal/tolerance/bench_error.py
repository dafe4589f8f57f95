"""The image error of one built bench: as it is, corrected by the procedures, and with a hologram of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from holocal.optics.bench import Array, Bench, Pose
from holocal.tolerance import light as light_of
from holocal.tolerance import picture, wavefront
from holocal.tolerance.arrival import Arrival, arrival
from holocal.tolerance.design import Design, sent_light
from holocal.units import DEGREE, MM

LEAST_LIT = 0.02  # of the pupil: the procedure `distortion` asks for no spot with less
STAGES = ("before", "after", "pose")
METRICS = (
    "wavefront_median_rad",
    "wavefront_worst_rad",
    "distortion_rms_px",
    "distortion_max_px",
    "nonuniformity_rms",
    "light_fraction",
    "field_coverage",
)

Numbers = dict[str, float]


def built_bench(design: Design, freedoms: ArrayLike) -> Bench:
    """Return the bench with its twelve degrees of freedom (12,) in degrees and millimetres, in the file's order."""
    turn_m, move_m, turn_s, move_s = np.asarray(freedoms, np.float64).reshape(4, 3)

    def pose(turn_deg: Array, move_mm: Array) -> Pose:
        (rx, ry, rz), (dx, dy, dz) = (turn_deg * DEGREE).tolist(), (move_mm * MM).tolist()
        return Pose((rx, ry, rz), (dx, dy, dz))

    return replace(design.bench, mirror=pose(turn_m, move_m), slm=pose(turn_s, move_s))


def bench_error(design: Design, freedoms: ArrayLike) -> dict[str, Numbers]:
    """Return the numbers of `METRICS` for every one of `STAGES`, and what explains them under "more".

    What cannot be told, of a bench whose field is dark or out of the camera's sight, is NaN.
    """
    built = built_bench(design, freedoms)
    light = sent_light(design)
    seen = arrival(design, built, light)
    known = (seen.lit >= LEAST_LIT) & design.in_field(seen.seen_tan)
    true = light_of.of_true_hologram(design, built)
    found: dict[str, Numbers] = {stage: {} for stage in STAGES}
    more: Numbers = {}
    _wavefronts(design, seen, known, found)
    _distortions(design, seen, known, found, more)
    _lights(design, seen, known, true, found, more)
    more["nyquist_use"] = true.nyquist_use
    more["beyond_nyquist"] = true.beyond_nyquist
    return {**{stage: {name: found[stage][name] for name in METRICS} for stage in STAGES}, "more": more}


def _wavefronts(design: Design, seen: Arrival, known: NDArray[np.bool_], found: dict[str, Numbers]) -> None:
    before, after = wavefront.errors(seen, design, known)
    judged = ~wavefront.zone_rows()[known]
    values = {"before": before[judged], "after": after[judged], "pose": np.zeros(np.count_nonzero(judged))}
    for stage, value in values.items():
        found[stage]["wavefront_median_rad"] = float(np.median(value)) if len(value) else float("nan")
        found[stage]["wavefront_worst_rad"] = float(np.max(value)) if len(value) else float("nan")


def _distortions(
    design: Design, seen: Arrival, known: NDArray[np.bool_], found: dict[str, Numbers], more: Numbers
) -> None:
    sent_tan = sent_light(design).field_tan
    off = picture.distances(design, sent_tan, seen.seen_tan, known)
    stages = (("before", off.before), ("after", off.mapped), ("pose", np.zeros(len(off.before))))
    for stage, value in stages:
        found[stage]["distortion_rms_px"] = _rms(value)
        found[stage]["distortion_max_px"] = float(np.max(value)) if len(value) else float("nan")
    more["corners_rms_px"] = _rms(off.corners)
    more["corners_max_px"] = float(np.max(off.corners)) if len(value) else float("nan")
    shift = (seen.seen_tan - sent_tan)[known].mean(axis=0) if known.any() else np.full(2, np.nan)
    more["shift_px"] = float(np.linalg.norm(shift)) / design.pixel_tan


def _lights(
    design: Design, seen: Arrival, known: NDArray[np.bool_], true: light_of.TrueLight, found: dict[str, Numbers],
    more: Numbers,
) -> None:  # fmt: skip
    nominal = light_of.nominal_brightness(design)
    wanted = nominal.correctable
    full = float(nominal.parts[wanted].mean())
    least = light_of.FLOOR * float(nominal.lit.max())
    field = nominal.covered(least)
    as_is, mapped = light_of.of_nominal_hologram(design, seen)
    for stage, bright in (("before", as_is), ("after", mapped), ("pose", true.brightness)):
        uneven, price = (bright.nonuniformity, 1.0) if stage == "before" else light_of.evened_out(bright)
        found[stage]["nonuniformity_rms"] = uneven
        found[stage]["light_fraction"] = price * float(bright.parts[wanted].mean()) / full
        found[stage]["field_coverage"] = float(np.mean(bright.covered(least)[field]))
    inside = nominal.inside
    more["lit_share"] = float(np.mean(true.brightness.lit[inside]) / np.mean(nominal.lit[inside]))
    more["even_field"] = float(np.mean(mapped.correctable[wanted]))


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2))) if len(value) else float("nan")
