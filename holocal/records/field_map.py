"""A correction's map over directions, read between its pixels: by what applies it, and by what checks it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.records.calibration import Accepted
from holocal.units import DEGREE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FieldMap:
    """Values (h, w) over a rectangle of tangents (left, right, bottom, top), pixel centres half a pixel inside."""

    values: Array
    extent_tan: tuple[float, float, float, float]

    def at(self, field_tan: Array) -> Array:
        """Return the values (n,) at tangents (n, 2), bilinear; beyond the map its edge holds."""
        left, right, bottom, top = self.extent_tan
        height, width = self.values.shape
        column = np.clip((field_tan[:, 0] - left) / (right - left) * width - 0.5, 0, width - 1)
        row = np.clip((top - field_tan[:, 1]) / (top - bottom) * height - 0.5, 0, height - 1)
        x, y = (
            np.minimum(np.floor(place).astype(int), max(size - 2, 0))
            for place, size in ((column, width), (row, height))
        )
        right_of, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
        u, v = column - x, row - y
        upper = self.values[y, x] * (1 - u) + self.values[y, right_of] * u
        lower = self.values[below, x] * (1 - u) + self.values[below, right_of] * u
        return np.asarray(upper * (1 - v) + lower * v)


def field_map(accepted: Accepted, channel: str) -> FieldMap:
    """Return a channel of an accepted run over its directions; `InputError` when it has none of that name."""
    values, extent = accepted.maps.channels.get(channel), accepted.maps.extent_deg
    if values is None or extent is None:
        raise missing(accepted, f"channel {channel} with an extent")
    left, right, bottom, top = (float(np.tan(angle * DEGREE)) for angle in extent)
    return FieldMap(np.asarray(values, np.float64), (left, right, bottom, top))


def missing(accepted: Accepted, what: str) -> InputError:
    """Return the error of an accepted run that lacks what its procedure promises."""
    return InputError(
        f"the {accepted.procedure} calibration {accepted.entry} has no {what}.",
        fix="Measure it again, or use `--corrections none`.",
    )
