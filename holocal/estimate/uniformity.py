"""How uneven a picture is, with the speckle taken out, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.estimate.blocks import Array, block_means

POINTS = (1 / 6, 1 / 2, 5 / 6)  # of width and height: the nine points of ICDM's sampled vantage-point uniformity


@dataclass(frozen=True)
class Uniformity:
    """Non-uniformity of a field.

    `rms` is the standard deviation over the mean of the local mean brightness, the speckle's own variance subtracted;
    `rms_sigma` its standard error; `nine_point` is 1 - min / max of the nine points, `nine_point_sigma` what the
    speckle alone adds to it about (the standard error of a point times sqrt 2); `mean` the mean brightness.
    """

    rms: float
    rms_sigma: float
    nine_point: float
    nine_point_sigma: float
    mean: float


def measure_uniformity(pictures: Array, valid: NDArray[np.bool_], *, block_px: int) -> Uniformity:
    """Return the non-uniformity of pictures (n, height, width) over `valid` (height, width).

    Pictures are brought to the same mean and averaged; blocks that lie in `valid` to nine tenths count. The variance
    between blocks less that which speckle gives a block of the average is the field's own; where it comes out negative
    the field is more even than the measurement can tell and `rms` is 0 (then read `rms_sigma`).

    Raises
    ------
    InputError
        Fewer than nine blocks are valid.
    """
    pictures = np.atleast_3d(pictures) if pictures.ndim == 2 else pictures
    pictures = pictures.reshape(-1, *valid.shape)
    level = pictures[:, valid].mean(axis=1)
    if not np.all(level > 0):
        raise InputError("A picture holds no light in the correctable field.", measured=float(level.min()), limit=0.0)
    scaled = pictures * (level.mean() / level)[:, None, None]
    blocks = block_means(scaled, block_px)
    inside = block_means(valid.astype(np.float64), block_px).mean > 0.9
    count = int(np.count_nonzero(inside))
    if count < 9:
        raise InputError(
            f"The correctable field holds {count} blocks of {block_px} pixels; at least 9 are needed.",
            fix="Use smaller blocks (block_px) or a lower floor.",
            measured=count,
            limit=9,
        )
    each = blocks.mean[:, inside] / blocks.mean[:, inside].mean()
    relative = each.mean(axis=0) / each.mean() - 1
    variance = float(np.mean(relative**2)) * count / (count - 1)
    frames = len(pictures)
    if frames > 1:  # independent frames tell the noise whatever the size of the grains
        noise = float(np.mean(np.var(each, axis=0, ddof=1))) / frames
        noise_error = noise * np.sqrt(2 / (count * (frames - 1)))
    else:
        noise = float(np.mean(blocks.relative_variance[inside]))
        noise_error = 0.3 * noise  # grains as large as a third of a block are under-estimated by that much
    own = variance - noise
    # The blocks' sample variance scatters by sqrt(2 / count) of itself.
    error = float(np.hypot(np.sqrt(2 / count) * (max(own, 0) + noise), noise_error))
    rms = float(np.sqrt(max(own, 0.0)))
    sigma = float(error / (2 * rms)) if own > error else float(np.sqrt(error))
    points, point_noise = _nine_points(scaled, valid, block_px)
    return Uniformity(
        rms,
        sigma,
        float(1 - points.min() / points.max()),
        float(np.sqrt(2 * point_noise)),
        float(level.mean()),
    )


def _nine_points(pictures: Array, valid: NDArray[np.bool_], block_px: int) -> tuple[Array, float]:
    """Return the nine points' brightness and the relative variance that speckle gives each.

    They lie at 1/6, 1/2 and 5/6 of the largest rectangle inside the correctable field; each is the mean over a square
    of two blocks a side, as a luminance meter's spot is far larger than a pixel.
    """
    top, bottom, left, right = inscribed_rectangle(valid)
    half = min(block_px, (bottom - top) // 6, (right - left) // 6)
    values, noise = [], []
    for v in POINTS:
        for u in POINTS:
            row, column = round(top + v * (bottom - top)), round(left + u * (right - left))
            spot = pictures[:, max(row - half, 0) : row + half, max(column - half, 0) : column + half]
            values.append(spot.mean())
            noise.append(
                float(np.mean(block_means(spot, block_px).relative_variance)) * block_px**2 / (4 * half * half)
            )
    return np.array(values), float(np.mean(noise)) / len(pictures)


def inscribed_rectangle(valid: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Return the largest rectangle (top, bottom, left, right; ends excluded) with every pixel valid.

    By heights of columns and a stack, row by row, on cells of four pixels a side.
    """
    step = 4
    rows, columns = (size // step for size in valid.shape)
    cells = valid[: rows * step, : columns * step].reshape(rows, step, columns, step)
    coarse = np.asarray(cells.all(axis=(1, 3)))
    heights = np.zeros(coarse.shape[1] + 1, int)
    best, found = 0, (0, 0, 0, 0)
    for row, line in enumerate(coarse):
        heights[:-1] = np.where(line, heights[:-1] + 1, 0)
        stack: list[int] = []
        for column, height in enumerate(heights):
            while stack and heights[stack[-1]] >= height:
                tall = heights[stack.pop()]
                left = stack[-1] + 1 if stack else 0
                if tall * (column - left) > best:
                    best = int(tall * (column - left))
                    found = (row + 1 - int(tall), row + 1, left, column)
            stack.append(column)
    top, bottom, left, right = found
    return top * step, bottom * step, left * step, right * step
