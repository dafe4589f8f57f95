"""Whether two pictures are of one pattern: their difference against their noise, brightness apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame
from holocal.loop.reference import LEAST_VARIANCE, Mask, Reference

BLOCK = 8  # pixels: the field's brightness changes by a percent or two over it, speckle is finer


@dataclass(frozen=True)
class Sameness:
    """How like one another two pictures are: their difference over their noise, and their structure over it."""

    difference: float
    structure: float


def sameness(before: Frame, after: Frame, reference: Reference, full_scale: int) -> Sameness | None:
    """Return how far two pictures differ, brightness apart, in units of the variance of their noise.

    Both are taken in blocks of 8 x 8 pixels less each block's mean, so that a field that is brighter in the middle
    counts for nothing; `after` is compared with `before` times the ratio of their sums, so that exposure and drift
    count for nothing either. The same picture gives a difference of 1; independent speckle gives 1 + its structure.

    Returns
    -------
    Sameness | None
        None where too little light is seen to say anything.
    """
    signals = [_blocks(reference.signal(frame)) for frame in (before, after)]
    unclipped = (np.asarray(frame.counts) < full_scale for frame in (before, after))
    good = _blocks(reference.usable & np.logical_and(*unclipped))
    if good.size == 0:
        return None
    lit = _lit(signals, good)
    good &= lit[:, None]
    sums = [float(signal[good].sum()) for signal in signals]
    degrees = int(np.maximum(good.sum(axis=1) - 1, 0).sum())
    if min(sums) <= 0 or degrees < BLOCK**2:
        return None
    scale = sums[1] / sums[0]
    both = (signals[0] * scale + signals[1]) / 2  # the best guess at the picture, if it is one
    noise = [float(reference.variance(part[good]).mean()) for part in (both / scale, both)]
    spread = [_within(signal, good, degrees) for signal in signals]
    apart = _within(signals[1] - scale * signals[0], good, degrees)
    expected = max(noise[1] + scale**2 * noise[0], (1 + scale**2) * LEAST_VARIANCE)
    structure = max(spread[1] - noise[1], 0.0) + scale**2 * max(spread[0] - noise[0], 0.0)
    return Sameness(apart / expected, structure / expected)


def _blocks(values: NDArray[Any]) -> NDArray[Any]:
    """Return (blocks, BLOCK * BLOCK) of an array (height, width); what does not fill a block is left out."""
    rows, columns = (n // BLOCK for n in values.shape)
    cut = values[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    return np.ascontiguousarray(cut.transpose(0, 2, 1, 3)).reshape(rows * columns, BLOCK * BLOCK)


def _lit(signals: Sequence[NDArray[Any]], good: NDArray[Any]) -> Mask:
    """Return which blocks hold at least a tenth of the bright ones' light, either picture's."""
    count = np.maximum(good.sum(axis=1), 1)
    means = [np.asarray((signal * good).sum(axis=1) / count, np.float64) for signal in signals]
    shares = [mean / max(float(np.quantile(mean, 0.95)), 1e-9) for mean in means]
    return np.asarray((np.maximum(*shares) > 0.1) & (count >= BLOCK**2 // 2))


def _within(signal: NDArray[Any], good: NDArray[Any], degrees: int) -> float:
    """Return the variance within blocks, pooled over them."""
    values = np.where(good, signal, 0.0).astype(np.float64)
    count = np.maximum(good.sum(axis=1), 1)
    return float((np.sum(values**2) - np.sum(values.sum(axis=1) ** 2 / count)) / degrees)
