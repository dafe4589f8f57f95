"""The thesis's encoder, the iterative Fourier transform algorithm, as an `Encoder`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

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
        transform = cast(WindowedTransform, target.transform)
        return ifta(target.start.clone(), target.wanted, target.window, transform, iterations=self.iterations)
