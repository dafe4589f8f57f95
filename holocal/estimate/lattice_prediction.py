"""Where a cell of a grid of dots should be, from the indexed dots round it: a local quadratic with priors.

The priors make one formula serve everywhere: beside one dot the last known steps decide, amid many the dots do, and the
predicted deviation says which. All lengths are in units of the local spacing inside, in pixels outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

REACH = 3  # cells: a window of 7 x 7
NOISE = 0.04  # of a dot's place, in spacings: speckled spots; printed dots are ten times better
STEP_SIGMA = 0.15  # of a step between neighbours against the steps known nearby
BEND_SIGMA = 0.1  # of a second difference: a barrel whose corners are half as large has 0.09 there
FADING = 2.0  # cells over which dots count less

_ROW, _COLUMN = np.array(
    [(i, j) for i in range(-REACH, REACH + 1) for j in range(-REACH, REACH + 1) if (i, j) != (0, 0)]
).T
_WEIGHT = 1 / (1 + (_ROW**2 + _COLUMN**2) / FADING**2)
_FEATURES = np.stack([np.ones(len(_ROW)), _ROW, _COLUMN, _ROW**2 / 2, _ROW * _COLUMN, _COLUMN**2 / 2], axis=1)
_SQUARES = (_FEATURES[:, :, None] * _FEATURES[:, None, :]).reshape(-1, 36)
_PRIOR = np.diag([1e-6, *[(NOISE / STEP_SIGMA) ** 2] * 2, *[(NOISE / BEND_SIGMA) ** 2] * 3])


@dataclass
class Canvas:
    """Cells round a seed while they are filled.

    `cell` (height, width) holds the index of the dot in each cell, -1 where there is none; `steps` (height, width, 2,
    2) the step to the next row and to the next column, (x, y) in pixels, where a cell is filled.
    """

    cell: Integers
    steps: Array

    @classmethod
    def around(cls, dot: int, steps: Array, size: int = 129) -> Canvas:
        """Return a canvas with one dot in its middle."""
        cell = np.full((size, size), -1, np.int64)
        known = np.zeros((size, size, 2, 2))
        cell[size // 2, size // 2], known[size // 2, size // 2] = dot, steps
        return cls(cell, known)

    def widened(self) -> Canvas:
        """Return a canvas whose filled cells are far enough from its border to be looked round."""
        rows, columns = np.nonzero(self.cell >= 0)
        margin = 2 * REACH + 2
        height, width = self.cell.shape
        if min(rows.min(), columns.min()) >= margin and rows.max() < height - margin and columns.max() < width - margin:
            return self
        by = 64
        cell = np.pad(self.cell, by, constant_values=-1)
        return Canvas(cell, np.pad(self.steps, ((by, by), (by, by), (0, 0), (0, 0))))

    def holding(self, cells: Integers, dots: Integers, centre_px: Array) -> Canvas:
        """Return a canvas that holds more dots (n,) in cells (n, 2), which may lie beyond its border."""
        margin = 2 * REACH + 2
        before = np.maximum(margin - cells.min(axis=0), 0)
        after = np.maximum(cells.max(axis=0) + margin + 1 - self.cell.shape, 0)
        by = tuple(zip(before.tolist(), after.tolist(), strict=True))
        cell = np.pad(self.cell, by, constant_values=-1)
        steps = np.pad(self.steps, (*by, (0, 0), (0, 0)))
        rows, columns = (cells + before).T
        cell[rows, columns] = dots
        # The plane through the nearest of them: to the next row and the next column.
        _, near = cKDTree(centre_px[dots]).query(centre_px[dots], k=min(9, len(dots)))
        offset = (cells[near] - cells[near].mean(axis=1, keepdims=True)).astype(np.float64)
        place = centre_px[dots][near]
        normal = offset.transpose(0, 2, 1) @ offset + 1e-9 * np.eye(2)
        steps[rows, columns] = np.linalg.solve(normal, offset.transpose(0, 2, 1) @ place)
        return Canvas(cell, steps)


@dataclass(frozen=True)
class Places:
    """Of all dots: `centre_px` (n, 2), and `log_contrast` (n,), by which a ghost is told from its neighbours."""

    centre_px: Array
    log_contrast: Array


@dataclass(frozen=True)
class Predictions:
    """Predictions of m cells, each from the indexed dots round it.

    `place_px` (m, 2); `sigma` (m,) in spacings, infinite without any support; `steps` (m, 2, 2) in pixels, to the next
    row and the next column; `spacing_px` (m,); `log_contrast` (m,) the weighted mean of the dots; `support` (m,) their
    number.
    """

    place_px: Array
    sigma: Array
    steps: Array
    spacing_px: Array
    log_contrast: Array
    support: Integers


def predict(canvas: Canvas, dots: Places, rows: Integers, columns: Integers) -> Predictions:
    """Return where cells should be; a cell's own dot is not used for it.

    Parameters
    ----------
    canvas
        What is indexed so far.
    dots
        All of them.
    rows, columns
        (m,) cells of the canvas, at least `REACH` from its border.
    """
    at = (rows[:, None] + _ROW, columns[:, None] + _COLUMN)
    index = canvas.cell[at]
    there = index >= 0
    weight = there * _WEIGHT
    total = np.maximum(weight.sum(axis=1), 1e-12)
    share = (weight / total[:, None])[:, None]
    steps = np.matmul(share, canvas.steps[at].reshape(*there.shape, 4)).reshape(-1, 2, 2)
    seen = np.where(there[..., None], dots.centre_px[index], 0)
    anchor = np.matmul(share, seen)[:, 0]
    # Least squares of a quadratic about the steps known nearby: what is left of the places, against the features.
    left = (seen - anchor[:, None] - np.matmul(_FEATURES[:, 1:3], steps)) * weight[..., None]
    normal = (weight @ _SQUARES).reshape(-1, 6, 6) + _PRIOR
    inverse = np.linalg.inv(normal)
    solved = inverse @ np.matmul(_FEATURES.T, left)
    return Predictions(
        place_px=anchor + solved[:, 0],
        sigma=np.where(there.any(axis=1), NOISE * np.sqrt(inverse[:, 0, 0]), np.inf),
        steps=steps + solved[:, 1:3],
        spacing_px=np.sqrt(np.maximum(np.abs(np.linalg.det(steps)), 1e-12)),
        log_contrast=np.matmul(share, np.where(there, dots.log_contrast[index], 0)[..., None])[:, 0, 0],
        support=there.sum(axis=1),
    )
