"""One smooth brightness map from the block means of all frames: a Gaussian process with the panel's response fitted.

    log I_fb = g_f + m(b) + gamma log w_f(b) + noise

Frame f showed the weights w_f; m is the bench's own brightness (log), a Gaussian process over the field; gamma is how
strongly the picture follows the weights, 1 for an ideal display; g_f a gain per frame, since a phase-only panel sends
the light that one part of the image does not get to the others. The noise is the speckle's (`blocks`). All of it is
linear, so the posterior is exact; length and height of the process are those of the largest evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import distance_transform_edt
from skimage.measure import label

from holocal.errors import InputError
from holocal.estimate.blocks import Array, Blocks, block_means

# The noise that phase-only encoding leaves in the pupil lifts the dark: 0.93 to 0.96 after 10 iterations of IFTA.
GAMMA_MEAN, GAMMA_SIGMA = 0.95, 0.15
GAIN_SIGMA = 3.0  # of log gain: wide
LENGTHS = (0.15, 0.2, 0.3, 0.4, 0.6, 0.9)  # of the process, in half widths of the field
HEIGHTS = (0.3, 1.0, 3.0)  # its standard deviation, in log brightness
FAINT = 0.4  # blocks below this share of the floor are left out: the log of the field falls off a cliff there
MODEL_SIGMA = 0.003  # of log brightness per block and frame: what the model leaves out
# The response to the weights is not quite local where the field is steep: a frame shown with other weights than those
# now wanted tells a little less, by this share of the difference of the log weights.
MODEL_SLOPE = 0.06
MAP_STEP_PX = 8  # the map is smooth: it is evaluated this coarsely and interpolated


@dataclass(frozen=True)
class BrightnessMap:
    """The bench's own brightness over the picture.

    `brightness` (height, width) is relative, 1 at the brightest correctable place; `sigma` its relative standard error;
    `valid` where it is at least the floor, one connected region; `gamma`, `gamma_sigma` the exponent of the response;
    `length` the process's length in half widths of the field.
    """

    brightness: Array
    sigma: Array
    valid: NDArray[np.bool_]
    gamma: float
    gamma_sigma: float
    length: float


@dataclass(frozen=True)
class Posterior:
    """The process at the blocks: `mean` (k,), `covariance` (k, k) of log brightness; `gamma` and its variance."""

    mean: Array
    covariance: Array
    gamma: float
    gamma_variance: float
    evidence: float


def fit_brightness(
    blocks: Blocks, log_weights: Array, *, shown: NDArray[np.bool_], block_px: int, floor: float
) -> tuple[BrightnessMap, NDArray[np.bool_]]:
    """Return the map of frames whose block means are `blocks`, and which blocks it is fitted on, (rows, columns).

    Parameters
    ----------
    blocks
        Means (frames, rows, columns).
    log_weights
        Log of the mean weight that each block was shown with, (frames, rows, columns).
    shown
        Where the picture shows the image, (height, width): beyond the image's border nothing can be corrected.
    block_px
        As it was given to `block_means`.
    floor
        Share of the brightest below which the field counts as not correctable.

    Raises
    ------
    InputError
        There is no light.
    """
    natural = np.mean(blocks.mean / np.exp(GAMMA_MEAN * log_weights), axis=0)
    brightest = float(np.quantile(natural, 0.98))
    if not brightest > 0:
        raise InputError(
            "The frames hold no light: the block means less the dark frame are all zero or below.",
            why="There is no brightness to even out.",
            fix="Check that the light is on, the panel is driven and the camera looks into the mirror.",
            measured=brightest,
            limit=0.0,
            code="no-light",
        )
    height, width = shown.shape
    inside = block_means(shown.astype(np.float64), block_px).mean > 1 - 1e-9
    used = inside & (natural > FAINT * floor * brightest) & np.all(blocks.mean > 0, axis=0)
    if np.count_nonzero(used) < 9:
        raise InputError(
            f"Only {np.count_nonzero(used)} blocks of {used.size} are lit; a map needs 9.",
            fix="Check the camera's field against the display's.",
            measured=int(np.count_nonzero(used)),
            limit=9,
            code="no-light",
        )
    at = _places(blocks, used, height, width)
    apart = log_weights[:, used] - log_weights[-1][used]
    apart -= apart.mean(axis=1, keepdims=True)
    variance = blocks.relative_variance[used] + MODEL_SIGMA**2 + (MODEL_SLOPE * apart) ** 2
    y = np.log(blocks.mean[:, used]) + blocks.relative_variance[used] / 2  # the mean of a log lies below the log's
    candidates = [(length, size) for length in LENGTHS for size in HEIGHTS]
    fits = [_posterior(y, log_weights[:, used], variance, _kernel(at, at, *pair)) for pair in candidates]
    best = int(np.argmax([fit.evidence for fit in fits]))
    fit, (length, size) = fits[best], candidates[best]
    log_map, sigma = _everywhere(fit, at, length, size, height, width)
    valid = _correctable(np.where(shown, log_map, -np.inf), floor, margin_px=block_px)
    brightness = np.exp(log_map - log_map[valid].max())
    found = BrightnessMap(brightness, sigma, valid, fit.gamma, float(np.sqrt(fit.gamma_variance)), length)
    return found, used


def weights_for(found: BrightnessMap, floor: float) -> Array:
    """Return intensity weights, (height, width) in (0, 1], that make the correctable field as bright as its faintest.

    Beyond it, and where the map is below the floor, the weight is 1: nothing is divided by a small number.
    """
    lowest = float(found.brightness[found.valid].min())
    return np.asarray(np.minimum(np.maximum(found.brightness, lowest) / lowest, 1 / floor) ** (-1 / found.gamma))


def _kernel(one: Array, other: Array, length: float, size: float) -> Array:
    """Return the Matern-5/2 covariance of log brightness between places (k, 2) and (n, 2)."""
    distance = np.sqrt(np.sum((one[:, None] - other[None]) ** 2, axis=-1)) * (np.sqrt(5.0) / length)
    return np.asarray(size**2 * (1 + distance + distance**2 / 3) * np.exp(-distance))


def _places(blocks: Blocks, used: NDArray[np.bool_], height: int, width: int) -> Array:
    """Return the blocks' centres (k, 2) in half widths of the picture."""
    columns, rows = np.meshgrid(blocks.centre_columns, blocks.centre_rows)
    scale = 2 / max(height, width)
    return np.stack([(columns[used] - (width - 1) / 2) * scale, (rows[used] - (height - 1) / 2) * scale], axis=1)


def _posterior(y: Array, log_weight: Array, variance: Array, kernel: Array) -> Posterior:
    """Return the exact posterior of the linear model for data and noise variances (frames, k)."""
    frames, k = y.shape
    size = k + frames + 1
    precision = np.zeros((size, size))
    factor_kernel = cho_factor(kernel + 1e-9 * kernel[0, 0] * np.eye(k), lower=True)
    precision[:k, :k] = cho_solve(factor_kernel, np.eye(k))
    gains = np.arange(k, k + frames)
    precision[gains, gains] = GAIN_SIGMA**-2
    precision[-1, -1] = GAMMA_SIGMA**-2
    right = np.zeros(size)
    right[-1] = GAMMA_MEAN / GAMMA_SIGMA**2
    start = float(np.mean(y))
    noise = 1 / variance
    place = np.arange(k)
    precision[place, place] += noise.sum(axis=0)
    data = y - start
    right[:k] += np.sum(noise * data, axis=0)
    for f in range(frames):
        slope = noise[f] * log_weight[f]
        precision[place, k + f] += noise[f]
        precision[place, -1] += slope
        precision[k + f, k + f] += noise[f].sum()
        precision[k + f, -1] += slope.sum()
        precision[-1, -1] += slope @ log_weight[f]
        right[k + f] += noise[f] @ data[f]
        right[-1] += slope @ data[f]
    upper = np.triu(precision, 1)
    precision = np.diag(np.diag(precision)) + upper + upper.T
    factor = cho_factor(precision, lower=True)
    solved = cho_solve(factor, right)
    covariance = cho_solve(factor, np.eye(size))
    evidence = (
        -0.5 * (np.sum(data**2 * noise) + GAMMA_MEAN**2 / GAMMA_SIGMA**2 - right @ solved)
        - np.sum(np.log(np.diag(factor[0])))
        - np.sum(np.log(np.diag(factor_kernel[0])))
    )
    return Posterior(solved[:k], covariance[:k, :k], float(solved[-1]), float(covariance[-1, -1]), float(evidence))


def _everywhere(fit: Posterior, at: Array, length: float, size: float, height: int, width: int) -> tuple[Array, Array]:
    """Return the map's mean and standard error, (height, width) each, in log brightness.

    The error is that of the map's shape: what all places share is not known, and does not matter.
    """
    rows = np.linspace(0, height - 1, max(2, height // MAP_STEP_PX))
    columns = np.linspace(0, width - 1, max(2, width // MAP_STEP_PX))
    scale = 2 / max(height, width)
    x, y = np.meshgrid((columns - (width - 1) / 2) * scale, (rows - (height - 1) / 2) * scale)
    kernel = _kernel(at, at, length, size) + 1e-9 * size**2 * np.eye(len(at))
    factor = cho_factor(kernel, lower=True)
    gain = cho_solve(factor, _kernel(at, np.stack([x.ravel(), y.ravel()], axis=1), length, size)).T
    mean = gain @ fit.mean
    common = fit.covariance.mean(axis=0)  # covariance with the mean level of all blocks
    own = size**2 - np.sum(gain * _kernel(np.stack([x.ravel(), y.ravel()], axis=1), at, length, size), axis=1)
    variance = np.sum((gain @ fit.covariance) * gain, axis=1) - 2 * gain @ common + common.mean() + np.maximum(own, 0)
    shape, target = x.shape, (width, height)
    grids = [part.reshape(shape).astype(np.float32) for part in (mean, np.sqrt(np.maximum(variance, 0)))]
    return tuple(_resample(grid, target) for grid in grids)  # type: ignore[return-value]


def _resample(grid: NDArray[np.float32], size: tuple[int, int]) -> Array:
    """Return a grid whose corners are the picture's corner pixels at full size (width, height), bicubic."""
    width, height = size
    x = np.linspace(0, grid.shape[1] - 1, width, dtype=np.float32)
    y = np.linspace(0, grid.shape[0] - 1, height, dtype=np.float32)
    at = np.meshgrid(x, y)
    return np.asarray(cv2.remap(grid, at[0], at[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float64)


def _correctable(log_map: Array, floor: float, *, margin_px: int) -> NDArray[np.bool_]:
    """Return where the brightness is at least `floor` of its largest, the largest connected region of it.

    Less a margin of one block: on a steep border neither map nor registration is good enough to divide by.
    """
    bright = log_map >= log_map.max() + np.log(floor)
    bright = distance_transform_edt(np.pad(bright, 1, mode="edge"))[1:-1, 1:-1] > margin_px
    regions = label(bright, connectivity=1)
    counts = np.bincount(regions.ravel())
    counts[0] = 0
    return np.asarray(regions == counts.argmax())
