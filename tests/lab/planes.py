"""What tests of free-space propagation share: a wavelength, samples of a plane, a distance between fields."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

WAVELENGTH = 515e-9
Array = NDArray[np.float64]


def axes(rows: int, columns: int, pitch: tuple[float, float]) -> tuple[Array, Array]:
    """Return x and y (rows, columns) of samples `pitch` (y, x) apart, centred, y up."""
    y = ((rows - 1) / 2 - np.arange(rows)) * pitch[0]
    x = (np.arange(columns) - (columns - 1) / 2) * pitch[1]
    across, up = np.meshgrid(x, y)
    return across, up


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the relative L2 distance."""
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
