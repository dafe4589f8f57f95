"""The checks of camera and light on one random pattern: counts, linearity, clipping, drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.errors import SafetyStop
from holocal.loop import gates
from holocal.loop.devices import Frame
from holocal.loop.preflight.checks import Check, check, unknown
from holocal.loop.procedure import Shot
from holocal.loop.reference import Reference
from holocal.loop.shooting import Shooter
from holocal.records.facts import RigFacts

Array = NDArray[np.float64]
Levels = NDArray[np.uint8]

MOVED_LIMIT = 3.0  # change of the picture over its noise
LEVEL_WANTED = (0.1, 0.9)  # 99.9th percentile of the pattern's picture, of full scale
MOST_EXPOSURES = 6
CLIP_LIMIT = 1e-3  # of the pixels
EXPOSURE_SHARES = (1.0, 1.0, 0.25, 0.5, 1.0, 1.0)  # of the exposure found; a drift is interpolated to the shorter ones
# Cameras are linear to 1 %, a laser is steady to 1 % from frame to frame; a gamma of 0.98 is off by 2.8 % at a quarter.
LINEARITY_LIMIT = 0.03
LEAST_LIT_COUNTS = 5.0  # mean of the lit pixels at a quarter of the exposure: the black level is steady to 0.1


@dataclass
class Bench:
    """What the checks with light share: who shoots, what, and the exposure that was found."""

    shooter: Shooter
    facts: RigFacts
    pattern: Levels
    exposure_s: float = 0.0

    def shot(self, label: str, levels: Levels | None, exposure_s: float) -> Shot:
        """Return a shot in the middle wavelength."""
        lines = self.facts.wavelengths_m
        return Shot(f"pre-flight {label}", levels, exposure_s, lines[len(lines) // 2])

    def dark(self, exposure_s: float) -> Frame:
        """Return a frame without light."""
        return self.shooter.grab(self.shot("dark", None, exposure_s))

    def random(self, exposure_s: float) -> Frame:
        """Return a frame of the random pattern."""
        return self.shooter.grab(self.shot("pattern", self.pattern, exposure_s))

    def blank(self) -> Frame:
        """Return a frame of level 0 everywhere."""
        return self.shooter.grab(self.shot("blank", np.zeros_like(self.pattern), self.exposure_s))


def pattern_series(bench: Bench, offset: float) -> list[Frame]:
    """Return frames of the random pattern at the exposure that is found for it, two of them at a part of it.

    Raises
    ------
    SafetyStop
        The picture clips at the camera's shortest exposure.
    """
    first = find_exposure(bench, offset)
    bench.exposure_s = first.exposure_s
    return [first] + [bench.random(share * bench.exposure_s) for share in EXPOSURE_SHARES[1:]]


def of_one_exposure(series: Sequence[Frame]) -> list[Frame]:
    """Return the frames of a series that were taken at its whole exposure."""
    return [frame for frame, share in zip(series, EXPOSURE_SHARES, strict=True) if share == 1.0]


def camera_checks(
    series: Sequence[Frame], reference: Reference, facts: RigFacts, *, tolerated_drift: float
) -> list[Check]:
    """Return P07, P08, P09 and P12 of a series of the random pattern."""
    rates = lit_rates(series, reference)
    drift = drift_per_frame(rates)
    return [
        *count_checks(series[0], facts),
        linearity_check(rates, drift, series),
        drift_check(drift, len(series), tolerated_drift),
    ]


def find_exposure(bench: Bench, offset: float) -> Frame:
    """Return a frame of the random pattern at an exposure that neither clips nor drowns in noise."""
    camera = bench.facts.camera
    exposure_s = float(np.sqrt(camera.exposure_min_s * camera.exposure_max_s))
    for _ in range(MOST_EXPOSURES):
        frame = bench.random(exposure_s)
        level = (float(np.percentile(frame.counts, 99.9)) - offset) / camera.full_scale
        if LEVEL_WANTED[0] <= level <= LEVEL_WANTED[1]:
            return frame
        factor = 0.1 if level > LEVEL_WANTED[1] else min(30.0, 0.5 / max(level, 1e-3))
        wanted_s = min(max(frame.exposure_s * factor, camera.exposure_min_s), camera.exposure_max_s)
        if wanted_s == exposure_s:
            break
        exposure_s = wanted_s
    clipped = gates.clipped(frame, limit=0.01)
    if not clipped.ok and frame.exposure_s <= camera.exposure_min_s * (1 + 1e-6):
        raise SafetyStop(
            f"the camera saturates at its shortest exposure: {clipped.sentence}",
            why="Clipped light is not measured, and may harm the sensor.",
            fix="Put a neutral density filter in the beam or lower the laser's power by hand.",
            measured=clipped.measured,
            limit=clipped.limit,
            code="too-bright",
        )
    return frame


def count_checks(lit: Frame, facts: RigFacts) -> list[Check]:
    """Return whether counts stay within full scale and use their low bits (P07), and do not clip (P09)."""
    high, low, white = (
        gates.beyond_full_scale(lit, facts.camera),
        gates.low_bits_zero(lit),
        gates.clipped(lit, limit=CLIP_LIMIT),
    )
    return [
        check("P07a", "highest count", high.measured, high.limit, "counts", high.fix),
        check("P07b", "low bits that are always 0", low.measured, low.limit, "bits", low.fix),
        check("P09", "clipped pixels", white.measured, white.limit, "of pixels", "Lower the light by hand."),
    ]


def lit_rates(series: Sequence[Frame], reference: Reference) -> Array:
    """Return the brightness of each frame, counts per second, over the pixels that the pattern lights."""
    signals = [reference.signal(frame) for frame in series]
    level = 0.1 * float(np.quantile(signals[0][reference.usable], 0.99))
    lit = reference.usable & (signals[0] >= level)
    means = [float(signal[lit].mean()) if level > 0 else 0.0 for signal in signals]
    return np.array([mean / frame.exposure_s for mean, frame in zip(means, series, strict=True)])


def drift_per_frame(rates: Array) -> float | None:
    """Return the relative change from frame to frame, of the frames at one exposure; None without light."""
    number = np.flatnonzero(np.array(EXPOSURE_SHARES) == 1.0)
    if (rates <= 0).any():
        return None
    return float(np.polyfit(number, np.log(rates[number]), 1)[0])


def linearity_check(rates: Array, drift: float | None, series: Sequence[Frame]) -> Check:
    """Return whether brightness is in proportion to the exposure, at three exposures (P08).

    Automatic exposure leaves it constant, a gamma of 0.45 makes a quarter's twice too bright: both are far beyond the
    limit.
    """
    title = "brightness off its proportion to the exposure"
    remedy = "Switch the camera's automatic exposure, automatic gain and gamma off."
    number, share = np.arange(len(rates)), np.array(EXPOSURE_SHARES)
    exposures_s = np.array([frame.exposure_s for frame in series])
    least = float((rates * exposures_s).min())
    if drift is None or least < LEAST_LIT_COUNTS or np.ptp(exposures_s) < 0.5 * exposures_s.max():
        return unknown("P08", title, "The light is too faint, or too bright, for three exposures: change it by hand.")
    steady = rates * np.exp(-drift * number)
    off = float(np.max(np.abs(steady[share < 1] / steady[share == 1].mean() - 1)))
    return check("P08", title, round(off, 5), LINEARITY_LIMIT, "relative", remedy)


def drift_check(drift: float | None, frames: int, tolerated: float) -> Check:
    """Return whether the light stays what it is over the frames of one pattern (P12)."""
    title, remedy = "drift of the light", "Let the source warm up; check its current and temperature control."
    if drift is None:
        return unknown("P12", f"{title} over {frames} frames", "There is no light: see P10.")
    measured = round(abs(drift) * (frames - 1), 5)
    return check("P12", f"{title} over {frames} frames", measured, tolerated, "relative", remedy)
