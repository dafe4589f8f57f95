"""The thesis's encoder, the iterative Fourier transform algorithm, as an `Encoder`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import torch

from holocal.hologram.encode.encoder import Target
from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.ifta import Encoded, ifta


@dataclass(frozen=True)
class Ifta:
    """`ifta` with its number of iterations (thesis: 10). Needs a `WindowedTransform`.

    `warm` is the encoded field of the last frame (`Rendered.encoded`), to begin where it ended; None begins with the
    hologram's own phase.

    Examples
    --------
    >>> Ifta(iterations=2)
    Ifta(iterations=2)
    """

    iterations: int = 10
    warm: torch.Tensor | None = field(default=None, repr=False, compare=False)

    def __call__(self, target: Target) -> Encoded:
        """Return the field whose spectrum in the window is nearest to the wanted one."""
        transform = cast(WindowedTransform, target.transform)
        start = (target.start if self.warm is None else self.warm).clone()  # ifta overwrites it
        found = ifta(start, target.wanted, target.window, transform, iterations=self.iterations)
        if int(torch.count_nonzero(found.field)) < found.field.numel():
            # Where the hologram is 0 and nothing was added, ifta ends at 0, which no panel shows.
            found.field[found.field == 0] = 1
        return found
