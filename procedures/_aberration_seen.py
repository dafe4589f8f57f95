"""Where the camera sees the zones' spots: what a state of the aberration holds of it, light to import."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ZoneWindows:
    """Where the spots are looked for.

    `zones` (n,) are those that are looked at, `places` (n, 2) column and row of their windows' middle, `side` the
    windows' pixels, odd. `px_per_gradient` (2, 2): by how many columns and rows a gradient of 1 rad per pupil radius
    in the hologram's phase moves a spot. `reasons`: one per zone of the field, empty where it is looked at.
    """

    zones: NDArray[np.int64]
    places: NDArray[np.int64]
    side: int
    px_per_gradient: Array
    reasons: tuple[str, ...]
