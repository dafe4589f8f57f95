"""Distortion: where directions are seen against where they were sent, and what two corrections leave.

The corrections are those of the procedure `distortion`: the thesis's homography of the four outermost spots, and the
smooth map (homography, polynomials, spline, as far as held-out spots want them). Both are fitted to spots of the
field, as the procedure shows them, and judged at all others that the camera sees: where the picture has moved out of
the field it is filled from beyond it, and there the maps go on straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.map_fit import fit_smooth_map
from holocal.estimate.picture_map import FourCorners, outermost
from holocal.optics.bench import Array
from holocal.tolerance.design import FIELD, SENT, Design

FEWEST_SPOTS = 12  # below, the procedure makes no map


@dataclass(frozen=True)
class Distances:
    """Distances in camera pixels at directions that no map was fitted to, (n,) each; NaN where no map can be made."""

    before: Array
    corners: Array
    mapped: Array


def fitted_rows() -> NDArray[np.bool_]:
    """Return which of the SENT^2 directions a map is fitted to: every other one of the field, as on a chessboard."""
    row, column = np.indices((SENT, SENT))
    inside = (np.abs(row - SENT // 2) <= FIELD // 2) & (np.abs(column - SENT // 2) <= FIELD // 2)
    return np.asarray((inside & ((row + column) % 2 == 0)).ravel())


def distances(design: Design, sent_tan: Array, seen_tan: Array, known: NDArray[np.bool_]) -> Distances:
    """Return how far `known` directions (D, 2) are seen from where they should be, before and after both maps.

    A direction that is sent through a map's inverse is seen off by as much as the map is wrong there.
    """
    sent, seen = sent_tan / design.pixel_tan, seen_tan / design.pixel_tan
    fit, judge = fitted_rows() & known, ~fitted_rows() & known
    before = np.linalg.norm((seen - sent)[judge], axis=1)
    if np.count_nonzero(fit) < FEWEST_SPOTS:
        none = np.full(len(before), np.nan)
        return Distances(before, none, none)
    four = outermost(sent, fit)
    corners = FourCorners.through(sent[four], seen[four])
    smooth = fit_smooth_map(sent[fit], seen[fit])
    left = [np.linalg.norm(found(sent[judge]) - seen[judge], axis=1) for found in (corners, smooth)]
    return Distances(before, left[0], left[1])
