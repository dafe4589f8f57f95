"""What the pre-flight learns of camera and light, against which the gates then hold every frame.

Two pictures of one pattern differ by noise alone; how large that is, at any brightness, is found by photon transfer:
the variance between frames of one pattern against their brightness (J. Janesick, Photon Transfer, SPIE 2007),

    variance = read noise + gain x signal + (flicker x signal)^2,

all in counts. The last term takes in what else differs between frames of one pattern on this bench: pointing,
vibration, the flicker of the panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HOT_SIGMAS = 8.0  # above the dark frame's noise: one in 1e15 of a normal distribution
BINS = 12  # of brightness, for the photon transfer
LEAST_VARIANCE = 1 / 12  # counts^2: of rounding


@dataclass(frozen=True)
class Reference:
    """The camera's dark level and noise in counts, the light's rate, and whether two frames of one pattern differ.

    `usable` (height, width) leaves out hot pixels. `rate` is the mean of the dark-subtracted picture of a random
    pattern, counts per second: what the panel sends this way when it sends light everywhere; it was taken at
    `exposure_s`.
    """

    offset: float
    dark_rate: float
    read_variance: float
    gain: float
    flicker_squared: float
    rate: float
    noisy: bool
    usable: Mask
    exposure_s: float = 0.0

    def signal(self, frame: Frame) -> Array:
        """Return the dark-subtracted counts of a frame, (height, width)."""
        return np.asarray(frame.counts, np.float64) - self.dark_level(frame.exposure_s)

    def dark_level(self, exposure_s: float) -> float:
        """Return the mean counts without light."""
        return self.offset + self.dark_rate * exposure_s

    def variance(self, signal: Array) -> Array:
        """Return the variance of one frame's counts where the signal is so large."""
        lit = np.maximum(signal, 0.0)
        return np.asarray(self.read_variance + self.gain * lit + self.flicker_squared * lit**2)


def make_reference(darks: Sequence[Frame], same: Sequence[Frame]) -> Reference:
    """Return the reference of two dark frames (a short exposure, a longer one) and two or more of one pattern."""
    first, second = (np.asarray(frame.counts, np.float64) for frame in darks)
    usable = not_hot(darks[1])
    offset = float(first[usable].mean())
    longer_s = darks[1].exposure_s - darks[0].exposure_s
    dark_rate = (float(second[usable].mean()) - offset) / longer_s if longer_s > 0 else 0.0
    read_variance = max(float(np.var((second - first)[usable])) / 2, LEAST_VARIANCE)
    if abs(dark_rate) * longer_s < 3 * np.sqrt(2 * read_variance / max(int(usable.sum()), 1)):
        dark_rate = 0.0  # within the error of the means: extrapolated to longer exposures it would pass for light
    plain = Reference(offset, dark_rate, read_variance, 0.0, 0.0, 0.0, noisy=True, usable=usable)
    signals = [plain.signal(frame) for frame in same]
    gain, flicker_squared = photon_transfer(signals, usable, read_variance)
    rate = float(np.mean([s[usable].mean() / frame.exposure_s for s, frame in zip(signals, same, strict=True)]))
    noisy = not any(np.array_equal(a.counts, b.counts) for a, b in pairwise(same))
    return Reference(offset, dark_rate, read_variance, gain, flicker_squared, rate, noisy, usable, same[0].exposure_s)


def not_hot(dark: Frame) -> Mask:
    """Return the pixels of a dark frame, (height, width), that are no brighter than its noise explains."""
    counts = np.asarray(dark.counts, np.float64)
    level = float(np.median(counts))
    noise = max(1.4826 * float(np.median(np.abs(counts - level))), 0.5)
    return np.asarray(counts <= level + HOT_SIGMAS * noise)


def photon_transfer(signals: Sequence[Array], usable: Mask, read_variance: float) -> tuple[float, float]:
    """Return gain (counts per photo-electron) and squared flicker from pictures of one pattern, dark subtracted."""
    mean = np.mean(signals, axis=0)
    total = float(mean[usable].sum())
    if total <= 0:
        return 0.0, 0.0
    variance = np.zeros_like(mean)
    for one, other in pairwise(signals):
        scale = (
            float(other[usable].sum()) / total,
            float(one[usable].sum()) / total,
        )  # a drift of the source is no noise
        variance += (other / max(scale[0], 1e-6) - one / max(scale[1], 1e-6)) ** 2 / 2
    variance /= len(signals) - 1
    lit = usable & (mean > 0.05 * np.quantile(mean[usable], 0.99))
    edges = np.quantile(mean[lit], np.linspace(0, 1, BINS + 1)) if np.any(lit) else np.zeros(0)
    rows = []
    for low, high in pairwise(edges):
        part = lit & (mean >= low) & (mean <= high)
        if (count := int(part.sum())) >= BINS:
            s, v = float(mean[part].mean()), float(variance[part].mean())
            rows.append((s, s * s, v - read_variance, np.sqrt(count) / max(v, LEAST_VARIANCE)))  # sd of v: v / sqrt(n)
    if len(rows) < 2:
        return 0.0, 0.0
    return _fit(np.array(rows))


def _fit(rows: Array) -> tuple[float, float]:
    """Return gain and squared flicker, neither negative, of rows (signal, signal^2, variance, weight)."""
    weight = rows[:, 3]
    design, wanted = rows[:, :2] * weight[:, None], rows[:, 2] * weight
    both = np.linalg.lstsq(design, wanted, rcond=None)[0]
    if (both >= 0).all():
        return float(both[0]), float(both[1])
    alone = [max(float(column @ wanted / (column @ column)), 0.0) for column in design.T]
    left = [float(np.sum((wanted - column * value) ** 2)) for column, value in zip(design.T, alone, strict=True)]
    return (alone[0], 0.0) if left[0] <= left[1] else (0.0, alone[1])
