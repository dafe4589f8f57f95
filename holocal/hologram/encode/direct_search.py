"""Direct binary search, generalised from 2 to any number of levels (Seldowitz, Allebach & Sweeney, Appl. Opt. 26:2788).

With e = A^H (A u - s wanted) and p the squared norm of A on one pixel, changing pixel j by d changes the squared error
by p |d|^2 + 2 Re(conj(d) e_j). On the circle that is a constant less 2 Re(conj(u'_j) (p u_j - e_j)): the best phase is
that of p u_j - e_j, the best level the nearest to it, and nothing has to be tried. Pixels on a lattice so wide that
A^H A hardly couples them are changed together; then e is made again through the transform.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from holocal.hologram.encode.encoder import Misfit, Target, assess, masked, own_phase, power, to_unit, window_misfit
from holocal.hologram.encode.ifta import Encoded
from holocal.hologram.encode.levels import Levels


@dataclass(frozen=True)
class DirectSearch:
    """Searches until a pass over the pixels no longer pays; the error never rises.

    Parameters
    ----------
    passes
        At most; each takes one pair of transforms per place on the lattice, four for a window half as wide as the
        band.
    light
        The share of the panel's light that the signal shall have; None lets it be what fits best at each step.
    levels
        The phases that the panel has: their error is part of the search. None for any phase.
    least_gain
        A pass that lowers the error by a smaller share ends the search.
    """

    passes: int = 3
    light: float | None = None
    levels: Levels | None = None
    least_gain: float = 0.01

    def __call__(self, target: Target) -> Encoded:
        """Return the field; `signal_error` after each place on the lattice."""
        search = _Search.begin(self, target)
        errors = [search.misfit.error]
        steps = lattice(target)
        for _ in range(self.passes):
            before = errors[-1]
            for top in range(steps[0]):
                for left in range(steps[1]):
                    search.settle(slice(top, None, steps[0]), slice(left, None, steps[1]))
                    errors.append(search.misfit.error)
            if errors[-1] > (1 - self.least_gain) * before:
                break
        result = assess(search.field, target)
        return Encoded(result.field, result.efficiency, result.in_window, tuple(errors), len(errors) - 1, "")


def lattice(target: Target) -> tuple[int, int]:
    """Return the steps (rows, columns) of the lattice: as many as the window goes into the band."""
    fx, fy = target.transform.frequencies(1.0, 1.0)
    spans = []
    for lines, axis in ((fy, 1), (fx, 0)):
        used = lines[target.window.any(dim=axis).cpu().numpy()]
        spans.append(max(1, round(1 / max(float(used.max() - used.min()), 1e-6))) if len(used) else 1)
    return min(spans[0], target.transform.rows), min(spans[1], target.transform.columns)


def on_one_pixel(target: Target) -> float:
    """Return |A d|^2 for a field d that is 1 on one pixel: the share of all bins that the window holds."""
    one = torch.zeros_like(target.start)
    one[0, 0] = 1
    return power(masked(target.transform.forward(one), target.window))


@dataclass
class _Search:
    """The field as it stands, its misfit, and half the gradient that follows from it."""

    settings: DirectSearch
    target: Target
    wanted: torch.Tensor
    curvature: float
    field: torch.Tensor
    misfit: Misfit

    @classmethod
    def begin(cls, settings: DirectSearch, target: Target) -> _Search:
        wanted, start = target.wanted * target.window, own_phase(target.start)
        field = start if settings.levels is None else settings.levels.nearest(start)
        empty = Misfit(wanted, 0.0, 0.0, 0.0)
        search = cls(settings, target, wanted, on_one_pixel(target), field, empty)
        search.misfit = search.measure()
        return search

    def measure(self) -> Misfit:
        """Return the misfit of the field."""
        found = masked(self.target.transform.forward(self.field), self.target.window)
        light = self.settings.light
        return window_misfit(found, self.wanted, None if light is None else light * self.field.numel())

    def settle(self, rows: slice, columns: slice) -> None:
        """Give the pixels of one lattice their best values; half as far, or none at all, where that does not help."""
        excess = self.target.transform.adjoint(self.misfit.excess)[rows, columns]
        old = self.field[rows, columns].clone()
        best = old * self.curvature - excess
        for share in (1.0, 0.5, 0.2):
            # Towards `best` as far as `share` of it, measured as lengths that stand beside the old value's.
            moved = best.clone() if share == 1.0 else old.lerp(to_unit(best.clone()), share)
            self.field[rows, columns] = self._shown(to_unit(moved), rows, columns)
            misfit = self.measure()
            if misfit.error <= self.misfit.error:
                self.misfit = misfit
                return
        self.field[rows, columns] = old

    def _shown(self, phasors: torch.Tensor, rows: slice, columns: slice) -> torch.Tensor:
        levels = self.settings.levels
        return phasors if levels is None else levels.nearest(phasors, rows, columns)
