"""From frames of a pattern to the phases of its levels: which pixels are used, what noise they have, what they say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.fringes import Fringes, Noise, drift_of, fit_fringes, photon_transfer
from holocal.loop.devices import Frame
from holocal.records.facts import CameraFacts

Array = NDArray[np.float64]

MOST_PIXELS = 5000  # 0.001 rad per level; more cost time and tell nothing that matters
HEADROOM = 0.7  # of full scale: a fringe rises further at levels not yet shown
CLIPPED = 0.98
HOT_SIGMAS = 6.0
SPECKLE_PEAK = 2e-3  # of the pixels are brighter than what the exposure is set by
PEAK_AT = 0.35  # of full scale: the brightest 2e-4 then come near it
REFERENCE = 0  # the level that is shown again and again, for the source's drift


def bright_counts(frame: Frame) -> float:
    """Return what the brightest pixels hold above the dark level, but for the brightest 2e-3 of all."""
    low, high = np.quantile(frame.counts, [0.01, 1 - SPECKLE_PEAK])  # the corners of the field are dark
    return float(high - low)


def choose_pixels(frames: Sequence[Frame], dark: NDArray[np.uint16], camera: CameraFacts) -> NDArray[np.int64]:
    """Return the indices of the pixels whose brightness changes most against its noise, clipped and hot ones left out.

    With too few frames to say, a pixel's change includes its noise; 5000 of half a million are chosen all the same.
    """
    stack = np.stack([frame.counts.ravel() for frame in frames])
    low = dark.ravel().astype(np.float64)
    middle = float(np.median(low))
    spread = max(1.4826 * float(np.median(np.abs(low - middle))), 0.5)
    fit = (stack.max(axis=0) < HEADROOM * camera.full_scale) & (low < middle + HOT_SIGMAS * spread + 1)
    mean = np.maximum(stack.mean(axis=0) - low, 0.0)
    worth = np.where(fit, stack.var(axis=0) / (mean + spread**2 + 1), -1.0)
    order = np.argsort(-worth, kind="stable")[:MOST_PIXELS]
    return np.sort(order[worth[order] > 0])


def light_of(
    frames: Sequence[Frame],
    dark: NDArray[np.uint16],
    pixels: NDArray[np.int64],
    *,
    camera: CameraFacts,
    exposure_s: float,
) -> NDArray[np.float32]:
    """Return the counts (frames, n) of the pixels above the dark frame, brought to one exposure; NaN where clipped."""
    low = dark.ravel()[pixels].astype(np.float32)
    out = np.empty((len(frames), len(pixels)), np.float32)
    for row, frame in zip(out, frames, strict=True):
        counts = frame.counts.ravel()[pixels]
        row[:] = (counts.astype(np.float32) - low) * np.float32(exposure_s / frame.exposure_s)
        row[counts >= CLIPPED * camera.full_scale] = np.nan
    return out


def phases_of(light: NDArray[np.float32], shown: Sequence[int], times: Sequence[int]) -> Fringes:
    """Return the phases of the levels shown, `REFERENCE` at least twice among them; the first is level 0."""
    good = np.isfinite(light).all(axis=0)
    counts, level_of, when = light[:, good].astype(np.float64), np.asarray(shown, np.int64), np.asarray(times, float)
    repeats = np.flatnonzero(level_of == REFERENCE)
    again = counts[repeats]
    noise = photon_transfer(again) if again.shape[1] else Noise(1.0, 1.0)
    sums = again.sum(axis=1)
    scatter = float(noise.variance(again.mean(axis=0)).sum() / max(sums.mean(), 1.0) ** 2) if again.size else 0.0
    return fit_fringes(
        counts, level_of, noise=noise, drift=drift_of(np.maximum(sums, 1e-9), when[repeats], scatter), times=when
    )
