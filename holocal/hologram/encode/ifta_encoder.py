"""The thesis's encoder, the iterative Fourier transform algorithm, as an `Encoder`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch

from holocal.hologram.encode.encoder import Target
from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.ifta import Encoded, ifta


@dataclass(frozen=True)
class Ifta:
    """`ifta` with its number of iterations (thesis: 10). Needs a `WindowedTransform`.

    Examples
    --------
    >>> Ifta(iterations=2)
    Ifta(iterations=2)
    """

    iterations: int = 10

    def __call__(self, target: Target) -> Encoded:
        """Return the field whose spectrum in the window is nearest to the wanted one."""
        start = torch.where(target.start == 0, torch.ones_like(target.start), target.start)  # ifta overwrites it
        transform = cast(WindowedTransform, target.transform)
        found = ifta(start, target.wanted, target.window, transform, iterations=self.iterations)
        # Nothing wanted and everything looked at: ifta ends at 0, which no panel shows.
        field = torch.where(found.field == 0, torch.ones_like(found.field), found.field)
        return Encoded(field, found.efficiency, found.in_window, found.signal_error)
