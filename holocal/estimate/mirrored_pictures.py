"""What two pictures of a spot, one the other's mirror if nothing is wrong, say about what is wrong.

Light of any amplitude over a pupil and phase W makes the picture that -W makes, turned by half a turn. So a spot that
is seen through a bias and through its opposite gives two pictures that are each other's mirror if and as far as there
is no aberration: whatever the amplitude, the width of pixels, the scale, rotation or skew of the camera. Their
difference is odd in the aberration. How it answers to each mode is measured by pushing the mode, not modelled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUGH = 0.03  # of a pixel's light: what encoding noise adds, as weights of the fit; the errors come from the residuals
SATURATED = 0.93  # of full scale: above it a pixel with a dark level of some percent may have been clipped
LONGEST_RAD = 3.0  # of one step, rms over the lit part


@dataclass(frozen=True)
class Noise:
    """The law of a camera: variance in counts squared = `read` + `counts_per_electron` times counts."""

    read: float
    counts_per_electron: float

    def variance(self, counts: Array) -> Array:
        """Return the variance of dark-subtracted counts."""
        return self.read + self.counts_per_electron * np.maximum(counts, 0.0)


@dataclass(frozen=True)
class Pair:
    """Two pictures (zones, h, w) over their totals, the second turned: half their sum, their difference, its variance.

    `usable` (zones, h, w) where both pictures are; `lit` (zones,) where both have light that stands out of the noise.
    """

    mean: Array
    difference: Array
    variance: Array
    usable: Mask
    lit: Mask


@dataclass(frozen=True)
class Step:
    """What is wrong in one zone: `modes_rad` with its `covariance`, the spot's place `shift_px` (column, row).

    `left` (h, w) is the part of the difference that the modes do not explain; `misfit` its reduced chi-squared against
    the camera's noise alone (2 to 6 with encoding noise of 1.5 % of a spot's power).
    """

    modes_rad: Array
    covariance: Array
    shift_px: Array
    left: Array
    misfit: float


def has_light(counts: Array, usable: Mask, noise: Noise) -> Mask:
    """Return (zones,) where the brightest 3 x 3 pixels stand out by eight standard errors."""
    kept = np.where(usable, counts, 0.0)
    smooth = _blur_matrix(counts.shape[1], 1.0) @ kept @ _blur_matrix(counts.shape[2], 1.0)
    level = np.median(smooth, axis=(1, 2))
    # a Gaussian of 1 pixel averages 4 pi pixels; the level of an empty window is its median
    error = np.sqrt(noise.variance(level) / (4 * np.pi))
    return np.asarray(smooth.max(axis=(1, 2)) - level > 8 * error)


def centroid_px(counts: Array, usable: Mask) -> Array:
    """Return (zones, 2) column and row of the light's centroid from the window's centre, faint pixels left out."""
    kept = np.where(usable, counts, 0.0)
    smooth = _blur_matrix(counts.shape[1], 0.7) @ kept @ _blur_matrix(counts.shape[2], 0.7)
    # 6 %: read noise and background far out would pull the centroid to the window's centre
    bright = np.maximum(smooth - 0.06 * smooth.max(axis=(1, 2), keepdims=True), 0.0)
    total = np.maximum(bright.sum(axis=(1, 2)), 1e-12)
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in counts.shape[1:])
    return np.stack([bright.sum(axis=1) @ columns / total, bright.sum(axis=2) @ rows / total], axis=1)


def share_within(counts: Array, usable: Mask, noise: Noise) -> tuple[Array, Array]:
    """Return (zones,) the share of a spot's light that its brightest 3 x 3 pixels hold, and its standard error.

    The spot's light is that of 15 x 15 pixels: over a whole window read noise sums to a sixth of a faint spot.
    """
    kept = np.where(usable, counts - np.median(counts, axis=(1, 2), keepdims=True), 0.0)
    inner, outer = (_boxes(kept, half) for half in (1, 7))
    error = _boxes(np.where(usable, noise.variance(counts), 0.0), 7)
    best = inner.reshape(len(counts), -1).argmax(axis=1)
    core, total, variance = (
        part.reshape(len(counts), -1)[np.arange(len(counts)), best] for part in (inner, outer, error)
    )
    total = np.maximum(total, 1e-12)
    return core / total, np.sqrt(variance) / total


def mirrored_pair(one: Array, one_usable: Mask, other: Array, other_usable: Mask, noise: Noise) -> Pair:
    """Return what two pictures at opposite biases say together.

    A pixel that is unusable in one picture takes the other's value at its mirror place: it then says nothing.
    """
    turned, turned_usable = other[:, ::-1, ::-1], other_usable[:, ::-1, ::-1]
    lit = has_light(one, one_usable, noise) & has_light(other, other_usable, noise)
    both = one_usable & turned_usable
    totals = [np.maximum(np.where(both, p, 0.0).sum(axis=(1, 2), keepdims=True), 1e-12) for p in (one, turned)]
    first, second = one / totals[0], turned / totals[1]
    middle = np.where(both, (first + second) / 2, np.where(one_usable, first, np.where(turned_usable, second, 0.0)))
    variance = noise.variance(one) / totals[0] ** 2 + noise.variance(turned) / totals[1] ** 2
    return Pair(middle, np.where(both, first - second, 0.0), variance, both, lit)


def solve_step(
    pair: Pair, zone: int, slopes: Array, *, blur_px: float, centre_rad: Array, prior_rad: Array, rough: float = ROUGH
) -> Step:
    """Return what is wrong in one zone, from the difference of its pair.

    Parameters
    ----------
    slopes
        (modes, h, w) the difference's answer per rad of each mode.
    blur_px
        Both sides are smoothed by a Gaussian: differences of pictures are linear in shifts up to their grain.
    centre_rad, prior_rad
        (modes,) what the modes were expected to be before the search, and how sure that is: bounds what is badly seen.
    """
    rows, columns = (_blur_matrix(n, blur_px) for n in pair.mean.shape[1:])
    mean, difference, variance = pair.mean[zone], pair.difference[zone], pair.variance[zone]
    raw = np.concatenate([slopes, _nuisances(mean)]) * pair.usable[zone]
    design = (rows @ raw @ columns).reshape(len(raw), -1).T
    smooth = np.maximum(rows @ mean @ columns, 0.0)
    # nothing is known better than a hundredth of the peak's roughness: the tails are not the place to fit
    weight = 1 / (rows @ variance @ columns + (rough * smooth) ** 2 + (0.03 * rough * smooth.max()) ** 2).ravel()
    target = (rows @ difference @ columns).ravel()
    count = len(slopes)
    scale = _noise_scale(design, target, weight) * max(1.0, 4 * np.pi * blur_px**2)
    known = np.zeros(len(raw))
    known[:count] = 1 / prior_rad**2
    inverse = np.linalg.inv((design.T * weight) @ design / scale + np.diag(known))
    pull = design.T @ (weight * target) / scale
    pull[:count] += known[:count] * centre_rad
    solution = inverse @ pull
    left = difference - np.tensordot(solution, raw, 1)
    spread = rows @ (design * weight[:, None]).T.reshape(raw.shape) @ columns / scale
    gain = spread.reshape(len(raw), -1)
    covariance = inverse @ ((gain * left.ravel() ** 2) @ gain.T + np.diag(known)) @ inverse
    misfit = float(np.sum(left**2 / variance) / (left.size - len(raw)))
    length = float(np.linalg.norm(solution[:count]))
    modes = solution[:count] * min(1.0, LONGEST_RAD / max(length, 1e-12))
    return Step(modes, covariance[:count, :count], solution[count : count + 2], left, misfit)


def _nuisances(mean: Array) -> Array:
    """Return the difference's answer (4, h, w) to a column and a row of shift, to power and to an even background."""
    along_rows, along_columns = np.gradient(mean)
    # a spot off by a pixel is off by one each way in the two pictures: -2 times the slope of the picture
    return np.stack([-2 * along_columns, -2 * along_rows, mean, np.full_like(mean, mean.max())])


def _noise_scale(design: Array, target: Array, weight: Array) -> float:
    """Return the mean square of a plain fit's weighted residuals."""
    root = np.sqrt(weight)
    fitted = np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0]
    left = (target - design @ fitted) * root
    return float(max(left @ left / max(len(target) - design.shape[1], 1), 1e-12))


def _boxes(values: Array, half: int) -> Array:
    """Return the sums over squares of 2 half + 1 pixels around every pixel."""
    rows, columns = (np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= half for n in values.shape[1:])
    return np.asarray(rows @ values @ columns)


def _blur_matrix(size: int, sigma_px: float) -> Array:
    """Return the symmetric matrix that smooths an axis by a Gaussian, dark outside the window."""
    distance = np.subtract.outer(np.arange(size), np.arange(size))
    kernel = np.exp(-0.5 * (distance / max(sigma_px, 1e-3)) ** 2)
    reach = np.arange(-4 * size, 4 * size + 1)
    return np.asarray(kernel / np.exp(-0.5 * (reach / max(sigma_px, 1e-3)) ** 2).sum())
