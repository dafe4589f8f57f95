"""A regular grid of dots in a picture: found, indexed, mapped; or refused with what was missing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from holocal.errors import RefusedError
from holocal.estimate.dot_detection import Dots, find_dots
from holocal.estimate.dot_indexing import DotIndex, index_dots
from holocal.estimate.map_fit import MEDIAN_OF_RAYLEIGH, fit_smooth_map
from holocal.estimate.smooth_map import SmoothMap

Array = NDArray[np.float64]

LEAST_DOTS = 12
LEAST_SIDE = 3  # rows, and columns
MOST_DISAGREEMENT = 0.09  # of the spacing: dots thrown at random, where they fit at all, disagree by 0.1
LEAST_SHARE = 0.25  # of the cells within the outermost dots that hold one


@dataclass(frozen=True)
class DotGrid:
    """An indexed grid.

    `found`: dots that were detected, indexed or not; `left_out_px` (m, 2): where those are that were not. Of the n
    indexed ones: `row`, `column` (n,) from 0, down and to the right; `centre_px` (n, 2), (x, y) with (0, 0) the centre
    of the top left pixel; `sigma_px` (n,) of each coordinate; `smooth_map`: (column, row) -> (x, y).
    """

    found: int
    left_out_px: Array
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    centre_px: Array
    sigma_px: Array
    smooth_map: SmoothMap

    @property
    def rows(self) -> int:
        """From the first to the last that has a dot."""
        return int(self.row.max()) + 1

    @property
    def columns(self) -> int:
        """From the first to the last that has a dot."""
        return int(self.column.max()) + 1


def detect_grid(image: NDArray[np.float32]) -> DotGrid:
    """Return the grid of dots, dark or bright, in a grey picture (height, width) that is linear in light.

    A dot whose place contradicts the map of the others (its surroundings moved it) has a sigma that says so.

    Raises
    ------
    RefusedError
        No grid of at least 12 dots in 3 rows and 3 columns is there.
    """
    dots = find_dots(image)
    index = index_dots(dots)
    _check(dots, index)
    centre, sigma = dots.centre_px[index.dot], dots.sigma_px[index.dot]
    lattice = np.column_stack([index.column, index.row]).astype(np.float64)
    found = fit_smooth_map(lattice, centre, sigma_px=sigma)
    off = np.linalg.norm(found.holdout_px, axis=1)
    # Speckle is no white noise, and the fits of single dots are too sure of themselves: the map knows better.
    sigma = sigma * max(1.0, float(np.median(off / sigma)) / MEDIAN_OF_RAYLEIGH)
    sigma = np.where(found.outlier, np.maximum(sigma, off / np.sqrt(2)), sigma)
    left_out = np.delete(dots.centre_px, index.dot, axis=0)
    return DotGrid(len(dots), left_out, index.row, index.column, centre, sigma, found)


def _check(dots: Dots, index: DotIndex) -> None:
    """Refuse what is no grid."""
    indexed = len(index.dot)
    fix = "Give a picture of a regular grid of dots, sharp, and large enough that a dot is 3 pixels wide."
    if indexed < LEAST_DOTS or min(index.rows, index.columns) < LEAST_SIDE:
        raise RefusedError(
            f"no grid of dots: {len(dots)} dots were found, {indexed} of them lie on a lattice of {index.rows} rows "
            f"and {index.columns} columns; at least {LEAST_DOTS} in {LEAST_SIDE} rows and columns are needed.",
            fix=fix,
            measured=indexed,
            limit=LEAST_DOTS,
            code="no-grid",
        )
    if not index.disagreement <= MOST_DISAGREEMENT:
        raise RefusedError(
            f"no grid of dots: the {indexed} dots that lie on a lattice at all are {index.disagreement:.3f} of its "
            f"spacing off it; the limit is {MOST_DISAGREEMENT}.",
            why="Spots at random places are about so far off.",
            fix=fix,
            measured=index.disagreement,
            limit=MOST_DISAGREEMENT,
            code="no-grid",
        )
    share = indexed / _cells_within(index)
    if share < LEAST_SHARE:
        raise RefusedError(
            f"no grid of dots: {indexed} dots fill {share:.0%} of the cells that they surround; the limit is "
            f"{LEAST_SHARE:.0%}.",
            fix=fix,
            measured=share,
            limit=LEAST_SHARE,
            code="no-grid",
        )


def _cells_within(index: DotIndex) -> float:
    """Return how many cells the outermost dots surround: a tilted target's cells in the picture form no rectangle."""
    hull = cv2.convexHull(np.column_stack([index.column, index.row]).astype(np.float32))
    return float(cv2.contourArea(hull)) + float(cv2.arcLength(hull, closed=True)) / 2 + 1
