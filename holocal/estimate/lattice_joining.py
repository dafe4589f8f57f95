"""Whether two pieces of a lattice, with a ruler or a shadow between them, are one, and by which shift of cells.

The cells of both, as functions of the place in the picture, must be one cubic: nearly as well as each piece alone has
its own, and far better than with any other shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

NEAR = 200  # dots of each piece, those nearest to the other
LEAST = 12
AS_GOOD = 3.0  # times what the pieces leave alone
AT_LEAST = 0.004  # of the spacing: what is left by chance of a precise grid
BETTER = 3.0  # than any other shift


@dataclass(frozen=True)
class Piece:
    """Dots of one piece: `cell` (n, 2) as (row, column) and `place_px` (n, 2)."""

    cell: Integers
    place_px: Array


def joined_cells(main: Piece, piece: Piece) -> Integers | None:
    """Return the cells (n, 2) of a piece in the rows and columns of the main one; None where that is not certain."""
    if min(len(main.cell), len(piece.cell)) < LEAST:
        return None
    near = _nearest(main, piece)
    far = _nearest(piece, near)
    scale, middle = _scale(near, far)
    ours, theirs = (near.place_px - middle) / scale, (far.place_px - middle) / scale
    guess = _terms(theirs, 2) @ _solved(_terms(ours, 2), near.cell)
    lifted = np.column_stack([far.cell, np.ones(len(far.cell))])
    turn = np.rint(np.linalg.lstsq(lifted, guess, rcond=None)[0][:2]).astype(np.int64)
    if not np.array_equal(np.abs(turn).sum(axis=0), [1, 1]) or not np.array_equal(np.abs(turn).sum(axis=1), [1, 1]):
        return None
    turned = far.cell @ turn
    first = np.rint(np.median(guess - turned, axis=0)).astype(np.int64)
    shifts = [first + np.array(step) for step in product((-2, -1, 0, 1, 2), repeat=2)]
    features = _terms(np.concatenate([ours, theirs]), 3)
    left = [_left(features, np.concatenate([near.cell, turned + shift])) for shift in shifts]
    alone = np.hypot(_left(_terms(ours, 3), near.cell), _left(_terms(theirs, 3), turned))
    order = np.argsort(left)
    best, next_best = left[order[0]], left[order[1]]
    if best > max(AS_GOOD * alone, AT_LEAST) or next_best < BETTER * best:
        return None
    cells = piece.cell @ turn + shifts[order[0]]
    taken = set(map(tuple, main.cell.tolist()))
    return None if any(cell in taken for cell in map(tuple, cells.tolist())) else np.asarray(cells, np.int64)


def _nearest(piece: Piece, other: Piece) -> Piece:
    distance, _ = cKDTree(other.place_px).query(piece.place_px)
    chosen = np.argsort(distance, kind="stable")[:NEAR]
    return Piece(piece.cell[chosen], piece.place_px[chosen])


def _scale(one: Piece, other: Piece) -> tuple[float, Array]:
    places = np.concatenate([one.place_px, other.place_px])
    low, high = places.min(axis=0), places.max(axis=0)
    return float((high - low).max() / 2), (low + high) / 2


def _terms(at: Array, degree: int) -> Array:
    x, y = at.T
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


def _solved(features: Array, cells: Integers) -> Array:
    return np.asarray(np.linalg.lstsq(features, cells.astype(np.float64), rcond=1e-6)[0])


def _left(features: Array, cells: Integers) -> float:
    """Return the rms distance in cells that a fit leaves."""
    rest = cells - features @ _solved(features, cells)
    freedom = max(len(cells) - features.shape[1], 1)
    return float(np.sqrt((rest**2).sum() / freedom))
