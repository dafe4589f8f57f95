"""The phases a panel can show in front of a reference: equal steps round the circle, turned from pixel to pixel."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch

from holocal.hologram.frame import LEVELS


@dataclass(frozen=True)
class Levels:
    """Equally spaced phases 2 pi k / count, less the phase that the panel shows besides the encoded field.

    Parameters
    ----------
    count
        How many.
    beside_rad
        (rows, columns) float32, what `panel_phase` adds to the encoded field's phase (reference less illumination), or
        None: quantised together with it, the field's own steps start elsewhere at every pixel.
    """

    count: int = LEVELS
    beside_rad: torch.Tensor | None = None

    def nearest(self, field: torch.Tensor, rows: slice = slice(None), columns: slice = slice(None)) -> torch.Tensor:
        """Return the unit phasors nearest to a field's phase; `rows` and `columns` say which pixels it is of."""
        step = 2 * pi / self.count
        phase = torch.angle(field)
        if self.beside_rad is None:
            phase = phase.div_(step).round_().mul_(step)
        else:
            beside = self.beside_rad[rows, columns]
            phase = phase.add_(beside).div_(step).round_().mul_(step).sub_(beside)
        return torch.polar(torch.ones_like(phase), phase)
