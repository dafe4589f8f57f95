"""The patterns of `response`: one level on a fixed set of rows, random but fixed levels on all others.

The eye's pupil lies midway between the orders 0 and 1 of the panel, so light reaches it from rows that alternate with
a period of 2 or 3 pixels; 2 is its middle. Rows that all alternate alike would light one spot, and fixed pixels that
all show the same would give every camera pixel the same fringe; so the rows' roles are exchanged, and the fixed level
is drawn anew, from cell to cell. Light then comes from everywhere, and fringes have every phase.

Rows of a period of 2 or 3 are mirror images of their neighbours, so a blur between adjoining pixels (crosstalk) leaves
two phases only and scales their difference, by 1 - 4 k for a period of 2 and 1 - 3 k for 3, k being the share that a
pixel takes from each neighbour. One period cannot tell a blur from a shorter range of phase; two can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELL_COLUMNS = 4  # and two periods of rows
MEASURED, VERIFIED = 3, 2  # rows per period


@dataclass(frozen=True)
class Pattern:
    """Where the level is shown, (height, width) bool, and what all other pixels show, (height, width) uint8."""

    on: NDArray[np.bool_]
    fixed: NDArray[np.uint8]

    def levels(self, level: int) -> NDArray[np.uint8]:
        """Return the frame that shows a level."""
        return np.asarray(np.where(self.on, np.uint8(level), self.fixed))


def pattern(height: int, width: int, *, count: int, period: int, seed: tuple[int, ...]) -> Pattern:
    """Return a pattern for a panel of `count` levels; the same seed gives the same pattern."""
    rng = np.random.default_rng(seed)
    cells = (-(-height // (2 * period)), -(-width // CELL_COLUMNS))
    exchanged, drawn = rng.random(cells) < 0.5, rng.integers(0, count, cells).astype(np.uint8)
    rows = (np.arange(height) % period < period // 2)[:, None]
    return Pattern(
        rows ^ _enlarged(exchanged, height, width, period).astype(np.bool_), _enlarged(drawn, height, width, period)
    )


def _enlarged(cells: NDArray[np.generic], height: int, width: int, period: int) -> NDArray[np.uint8]:
    tall = np.repeat(cells, 2 * period, axis=0)[:height]
    return np.asarray(np.repeat(tall, CELL_COLUMNS, axis=1)[:, :width], np.uint8)
