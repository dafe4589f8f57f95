"""Which row and column each dot of a picture belongs to: grown from the best seed, checked from all sides.

A cell is looked for where the indexed dots round it say, the surest first, across gaps last. Then each dot is held
against the prediction of all its neighbours, what disagrees is taken out, and only one connected piece is kept: steps
round any closed loop add up to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from holocal.estimate.dot_detection import Dots
from holocal.estimate.dot_scale import lattice_agreement
from holocal.estimate.lattice_joining import Piece, joined_cells
from holocal.estimate.lattice_prediction import NOISE, REACH, Canvas, Places, predict

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SEEDS = 6  # starts, each among the dots that no start before has reached
SEED_AGREEING = 5  # of six neighbours in place
ENOUGH = 0.6  # of the dots: no further seed then
NARROWEST, WIDEST = 0.12, 0.3  # of the spacing: how far from the prediction a dot is looked for
SURE = 0.10  # predicted deviation, in spacings, that is tried first
DOUBTFUL = 0.25
BRIDGES = (1, 2, 3, 4)  # cells that are looked across, when nothing nearer is found
OUTLIER_SIGMAS = 6.0
MEDIAN_OF_RAYLEIGH = 1.1774  # of the distance of Gaussian errors along two axes, in their deviations
OUTLIER_LEAST = 0.05  # of the spacing: nearer to its prediction no dot is an outlier
CONTRAST_LEAST = 0.8  # a factor of 2.2 either way: a ghost beside clean dots is fainter
CONTRAST_AT_ITS_PLACE = 3.0  # a factor of 20, for dots just where they should be: a shadow's edge
DOUBTFUL_REACH = (0.03, 0.1)  # of the spacing
COMPANIONS = 2  # indexed dots among the eight round a cell; lonely ones prove nothing
JOINED = (0.05, 0.3)  # of the spacing: how well a step between two dots must agree with the steps known there
JOINED_SIGMAS = 10.0
SPARSE = 0.1  # of the next row's dots: an outer row with fewer is the picture's edge, not the grid's
LINKS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (0, 3), (3, 0), (0, 4), (4, 0))
LEAST = 9
PIECES = 4  # more of them are looked for beside the largest
LEAST_PIECE = 12  # dots


@dataclass(frozen=True)
class DotIndex:
    """Dots with their cells: `dot` (k,) indices of the dots, `row` and `column` (k,) from 0.

    Rows run down the picture and columns to the right (for a camera rotated by less than 45 degrees). `disagreement` is
    the rms distance of a dot from its neighbours' prediction, in spacings; NaN where fewer than nine dots are indexed.
    """

    dot: Integers
    row: Integers
    column: Integers
    disagreement: float

    @property
    def rows(self) -> int:
        """From the first to the last that has a dot."""
        return int(self.row.max()) + 1 if len(self.row) else 0

    @property
    def columns(self) -> int:
        """From the first to the last that has a dot."""
        return int(self.column.max()) + 1 if len(self.column) else 0


def index_dots(dots: Dots) -> DotIndex:
    """Return the largest lattice that the dots form; an empty one where they form none.

    Doubtful dots found nothing: they fill cells whose neighbours say so precisely.
    """
    nothing = np.zeros(0, np.int64)
    none = DotIndex(nothing, nothing, nothing, float("nan"))
    sure = ~dots.doubtful
    if np.count_nonzero(sure) < LEAST + 1:
        return none
    places = Places(dots.centre_px, np.log(np.maximum(dots.contrast, 1e-12)))
    search = _Search(places, cKDTree(dots.centre_px), sure, _contrast_limit(places, sure))
    best = _largest(dots, search)
    if best is None:
        return none
    best = _grown(_connected(_consistent(best, places), places), search)
    best = _connected(_consistent(best, places), places)
    if np.count_nonzero(best.cell >= 0) < LEAST:
        return none
    everything = replace(
        search,
        free=np.ones(len(dots), bool),
        widest=_precise(best, places),
        contrast_limit=max(search.contrast_limit, CONTRAST_AT_ITS_PLACE),
    )
    best = _connected(_consistent(_grown(best, everything), places), places)
    best = _with_pieces(best, dots, search, everything)
    return _canonical(best, places)


def _with_pieces(canvas: Canvas, dots: Dots, search: _Search, everything: _Search) -> Canvas:
    """Return the canvas with the pieces that something lies in front of, as far as they certainly belong to it."""
    left = dots.doubtful.copy()
    for _ in range(PIECES):
        left[canvas.cell[canvas.cell >= 0]] = True
        if np.count_nonzero(~left) < LEAST_PIECE:
            break
        piece = _largest(replace(dots, doubtful=left), replace(search, free=~left))
        if piece is None:
            break
        piece = _connected(_consistent(piece, search.dots), search.dots)
        number = piece.cell[piece.cell >= 0]
        left[number] = True
        if len(number) < LEAST_PIECE:
            break
        main, other = (Piece(np.argwhere(c.cell >= 0), dots.centre_px[c.cell[c.cell >= 0]]) for c in (canvas, piece))
        cells = joined_cells(main, other)
        if cells is not None:
            canvas = canvas.holding(cells, number, search.dots.centre_px)
            canvas = _consistent(_grown(canvas, everything), search.dots)
    return canvas


@dataclass(frozen=True)
class _Search:
    """What cells are filled from: the dots that are `free` (n,) to be taken, within limits of place and contrast."""

    dots: Places
    tree: cKDTree
    free: NDArray[np.bool_]
    contrast_limit: float
    widest: float = WIDEST


def _largest(dots: Dots, search: _Search) -> Canvas | None:
    """Return the largest of what grows from a few seeds, or None."""
    sure = np.flatnonzero(~dots.doubtful)
    centre = dots.centre_px[sure]
    agreeing, first, second = lattice_agreement(centre, np.arange(len(centre)))
    amid = agreeing >= SEED_AGREEING
    if not amid.any():
        return None
    # The seed lies amid dots that agree with their own neighbours.
    around = cKDTree(centre[amid]).query_ball_point(centre, 2.6 * dots.spacing_px[sure], return_length=True)
    score = np.where(amid, around, 0)
    best: Canvas | None = None
    most = LEAST - 1
    for _ in range(SEEDS):
        if score.max() <= 0:
            break
        seed = int(np.argmax(score))
        canvas = _grown(Canvas.around(int(sure[seed]), _upright(first[seed], second[seed])), search)
        used = canvas.cell[canvas.cell >= 0]
        score[np.isin(sure, used)] = 0
        if len(used) > most:
            best, most = canvas, len(used)
        if most >= ENOUGH * len(sure):
            break
    return best


def _contrast_limit(dots: Places, sure: NDArray[np.bool_]) -> float:
    """Return by how much a dot's log contrast may differ from its neighbours': much where there is speckle."""
    _, index = cKDTree(dots.centre_px[sure]).query(dots.centre_px[sure], k=5)
    values = dots.log_contrast[sure]
    return max(CONTRAST_LEAST, 4 * float(np.median(np.abs(values[index[:, 1:]].mean(axis=1) - values))) * 1.48)


def _precise(canvas: Canvas, dots: Places) -> float:
    """Return how far from its prediction, in spacings, a doubtful dot may be: as far as the sure ones are."""
    rows, columns = np.nonzero(canvas.cell >= 0)
    said = predict(canvas, dots, rows, columns)
    off = np.linalg.norm(dots.centre_px[canvas.cell[rows, columns]] - said.place_px, axis=1) / said.spacing_px
    return float(np.clip(OUTLIER_SIGMAS * np.median(off) / MEDIAN_OF_RAYLEIGH, *DOUBTFUL_REACH))


def _upright(first: Array, second: Array) -> Array:
    """Return two steps (2, 2), the row's down, the column's to the right, made of two steps of any order and sign."""
    level = np.abs([first[0], second[1]]) / np.linalg.norm([first, second], axis=1)
    turned = np.abs([second[0], first[1]]) / np.linalg.norm([second, first], axis=1)
    column, row = (first, second) if level.sum() >= turned.sum() else (second, first)
    return np.stack([row * (1 if row[1] >= 0 else -1), column * (1 if column[0] >= 0 else -1)])


def _grown(canvas: Canvas, search: _Search) -> Canvas:
    """Return the canvas with every cell filled that a dot is found for."""
    tried = np.zeros(canvas.cell.shape, np.int64)
    bridge = 0
    while bridge < len(BRIDGES):
        wide = canvas.widened()
        if wide is not canvas:
            canvas, tried = wide, np.zeros(wide.cell.shape, np.int64)
        full = canvas.cell >= 0
        side = 2 * BRIDGES[bridge] + 1
        rows, columns = np.nonzero(_dilated(full, side) & ~full)
        bridge = 0 if _filled(canvas, search, tried, rows, columns) else bridge + 1
    return canvas


def _filled(canvas: Canvas, search: _Search, tried: Integers, rows: Integers, columns: Integers) -> bool:
    """Fill the surest of some cells; return whether any was. `tried` keeps the support that a cell failed with."""
    support = _sum_round(canvas.cell >= 0, 2 * REACH + 1)[rows, columns]
    open_ = support > tried[rows, columns]
    rows, columns = rows[open_], columns[open_]
    if not len(rows):
        return False
    said = predict(canvas, search.dots, rows, columns)
    sure = said.sigma < SURE
    chosen = np.flatnonzero(sure if sure.any() else said.sigma < DOUBTFUL)
    if not len(chosen):
        return False
    reach = np.clip(3 * np.hypot(said.sigma, NOISE), NARROWEST, WIDEST)[chosen]
    reach = np.minimum(reach, search.widest) * said.spacing_px[chosen]
    distance, dot = search.tree.query(said.place_px[chosen])
    tried[rows[chosen], columns[chosen]] = said.support[chosen]
    free = search.free.copy()
    free[canvas.cell[canvas.cell >= 0]] = False
    alike = np.abs(search.dots.log_contrast[dot] - said.log_contrast[chosen]) < search.contrast_limit
    found = (distance <= reach) & free[dot] & alike
    order = np.argsort(np.where(found, distance / reach, np.inf), kind="stable")[: np.count_nonzero(found)]
    _, once = np.unique(dot[order], return_index=True)  # of the cells that want a dot the nearest gets it
    winner = chosen[order[once]]
    canvas.cell[rows[winner], columns[winner]] = dot[order[once]]
    canvas.steps[rows[winner], columns[winner]] = said.steps[winner]
    # A sure cell that stays empty may hide an unsure one behind it: that is progress too.
    return bool(len(winner)) or bool(sure.any())


def _consistent(canvas: Canvas, dots: Places) -> Canvas:
    """Return the canvas without the dots that their neighbours contradict; steps are taken from the neighbours."""
    cell, steps = canvas.cell.copy(), canvas.steps.copy()
    off, limit = np.zeros(cell.shape), np.full(cell.shape, np.inf)
    stale = cell >= 0
    for _ in range(8):
        rows, columns = np.nonzero(stale & (cell >= 0))
        said = predict(Canvas(cell, steps), dots, rows, columns)
        steps[rows, columns] = said.steps
        distance = np.linalg.norm(dots.centre_px[cell[rows, columns]] - said.place_px, axis=1)
        off[rows, columns] = distance / said.spacing_px
        limit[rows, columns] = np.maximum(1, said.sigma / NOISE)
        full = cell >= 0
        if np.count_nonzero(full) < LEAST:
            break
        least = max(OUTLIER_LEAST, OUTLIER_SIGMAS * float(np.median(off[full])) / MEDIAN_OF_RAYLEIGH)
        size = np.where(full, off / (least * limit), 0)
        # Only the worst of each neighbourhood: its neighbours may be blamed for it.
        wrong = (size > 1) & (size >= maximum_filter(size, 3))
        lonely = full & (_sum_round(full, 3) - 1 < COMPANIONS)
        out = wrong | lonely
        if not out.any():
            break
        cell[out] = -1
        stale = _dilated(out, 2 * REACH + 1)
    return Canvas(cell, steps)


def _connected(canvas: Canvas, dots: Places) -> Canvas:
    """Return the canvas with the largest piece only, its dots joined by steps that agree with those known there."""
    rows, columns = np.nonzero(canvas.cell >= 0)
    number = np.full(canvas.cell.shape, -1)
    number[rows, columns] = np.arange(len(rows))
    said = predict(canvas, dots, rows, columns)
    off = np.linalg.norm(dots.centre_px[canvas.cell[rows, columns]] - said.place_px, axis=1) / said.spacing_px
    joined = float(np.clip(JOINED_SIGMAS * np.median(off) / MEDIAN_OF_RAYLEIGH, *JOINED)) if len(off) else JOINED[0]
    ends: list[tuple[Integers, Integers]] = []
    for i, j in LINKS:
        there = number[rows + i, columns + j]
        a, b = np.flatnonzero(there >= 0), there[there >= 0]
        step = dots.centre_px[canvas.cell[rows[b], columns[b]]] - dots.centre_px[canvas.cell[rows[a], columns[a]]]
        known = (canvas.steps[rows[a], columns[a]] + canvas.steps[rows[b], columns[b]]) / 2
        spacing = np.sqrt(np.abs(np.linalg.det(known)))
        good = (
            np.linalg.norm(step - i * known[:, 0] - j * known[:, 1], axis=1) < joined * np.hypot(i, j) ** 0.5 * spacing
        )
        ends.append((a[good], b[good]))
    a, b = (np.concatenate(side) for side in zip(*ends, strict=True))
    _, piece = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(len(rows),) * 2), directed=False)
    kept = piece == np.argmax(np.bincount(piece)) if len(piece) else np.zeros(0, bool)
    cell = np.full_like(canvas.cell, -1)
    cell[rows[kept], columns[kept]] = canvas.cell[rows[kept], columns[kept]]
    return Canvas(cell, canvas.steps)


def _canonical(canvas: Canvas, dots: Places) -> DotIndex:
    """Return the cells with rows down and columns to the right, counted from 0."""
    rows, columns = np.nonzero(canvas.cell >= 0)
    dot = canvas.cell[rows, columns]
    said = predict(canvas, dots, rows, columns)
    off = np.linalg.norm(dots.centre_px[dot] - said.place_px, axis=1) / said.spacing_px
    down, right = said.steps.mean(axis=0)
    if abs(down[1]) / np.hypot(*down) < abs(down[0]) / np.hypot(*down) and abs(right[0]) < abs(right[1]):
        rows, columns, down, right = columns, rows, right, down
    row = rows if down[1] >= 0 else -rows
    column = columns if right[0] >= 0 else -columns
    kept = _trimmed(row - row.min(), column - column.min())
    row, column = row[kept], column[kept]
    return DotIndex(dot[kept], row - row.min(), column - column.min(), float(np.sqrt(np.mean(off[kept] ** 2))))


def _trimmed(row: Integers, column: Integers) -> NDArray[np.bool_]:
    """Return which dots are left when outer rows and columns that have next to none are taken off."""
    kept = np.ones(len(row), bool)
    for _ in range(4 * LEAST):
        before = np.count_nonzero(kept)
        for line in (row, column, -row, -column):
            counts = np.bincount(line[kept] - line[kept].min())
            if len(counts) > 2 and counts[0] < SPARSE * counts[1]:
                kept &= line != line[kept].min()
        if np.count_nonzero(kept) == before:
            break
    return kept


def _dilated(cells: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(cells.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _sum_round(cells: NDArray[np.bool_], side: int) -> Integers:
    total = cv2.boxFilter(cells.astype(np.uint8), cv2.CV_32S, (side, side), normalize=False, borderType=0)
    return np.asarray(total, np.int64)
