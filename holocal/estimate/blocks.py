"""Local mean brightness of a speckled picture, block by block, and how noisy it is.

A speckle grain is smaller than a pixel or a few pixels wide; a block of some 33 pixels averages hundreds of grains. How
much noise that leaves is read off the block itself: its nine parts, less a plane, scatter by three times as much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

Array = NDArray[np.float64]

PARTS = 3  # per side of a block
_PLANE_FREEDOM = PARTS * PARTS - 3  # what is left of nine parts after a plane


@dataclass(frozen=True)
class Blocks:
    """Block means of one picture or several: `mean` (..., rows, columns), in the picture's unit.

    `relative_variance` (rows, columns) is the variance of a block mean of one picture over its square; `centre_rows`
    and `centre_columns` are the blocks' centres in pixels (pixel centres are whole numbers).
    """

    mean: Array
    relative_variance: Array
    centre_rows: Array
    centre_columns: Array


def block_edges(size_px: int, block_px: int) -> NDArray[np.intp]:
    """Return the edges of blocks as near to `block_px` wide as divides `size_px` evenly (to a pixel)."""
    count = max(1, round(size_px / block_px))
    return np.asarray(np.linspace(0, size_px, count + 1).round(), np.intp)


def block_means(pictures: Array, block_px: int) -> Blocks:
    """Return the block means of pictures (n, height, width) or (height, width), and their noise.

    Parameters
    ----------
    pictures
        Brightness with the dark frame subtracted; all with the same expected brightness up to a factor.
    block_px
        Wanted side of a block, pixels; at least 3.
    """
    pictures = np.asarray(pictures, np.float64)
    rows, columns = (block_edges(size, block_px) for size in pictures.shape[-2:])
    mean = _means(pictures, rows, columns)
    fine_rows, fine_columns = (_refined(edges) for edges in (rows, columns))
    parts = _means(pictures, fine_rows, fine_columns)
    shape = (*mean.shape[:-2], len(rows) - 1, PARTS, len(columns) - 1, PARTS)
    parts = np.moveaxis(parts.reshape(shape), -3, -2).reshape(*mean.shape, PARTS * PARTS)
    residual = parts - parts @ _plane_projector()
    spread = np.sum(residual**2, axis=-1) / _PLANE_FREEDOM / PARTS**2  # variance of the mean of nine parts
    floor = 1e-3 * np.max(np.abs(mean), initial=1e-147)  # its square is not 0
    relative = spread / np.maximum(np.abs(mean), floor) ** 2
    if relative.ndim > 2:
        relative = relative.mean(axis=0)
    # Six degrees of freedom per block and frame: the speckle changes slowly over the field, so neighbours are pooled.
    relative = np.asarray(uniform_filter(relative, size=3, mode="nearest"))
    return Blocks(mean, relative, *((edges[1:] + edges[:-1] - 1) / 2 for edges in (rows, columns)))


def _means(pictures: Array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
    sums = np.add.reduceat(np.add.reduceat(pictures, rows[:-1], axis=-2), columns[:-1], axis=-1)
    return np.asarray(sums / (np.diff(rows)[:, None] * np.diff(columns)))


def _refined(edges: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the edges with each block cut in `PARTS`."""
    share = np.arange(PARTS) / PARTS
    inner = (edges[:-1, None] + share * np.diff(edges)[:, None]).round().astype(np.intp).ravel()
    return np.append(inner, edges[-1])


def _plane_projector() -> Array:
    """Return the (9, 9) matrix that takes nine parts to the plane through them."""
    t = np.arange(PARTS) - (PARTS - 1) / 2
    y, x = np.meshgrid(t, t, indexing="ij")
    plane = np.stack([np.ones(PARTS * PARTS), x.ravel(), y.ravel()], axis=1)
    return np.asarray(plane @ np.linalg.pinv(plane))
