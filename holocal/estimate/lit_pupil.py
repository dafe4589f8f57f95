"""What of a wavefront can be seen through the lit part of a pupil, and a bias that spreads its spot evenly.

Over a part of the disc Zernike polynomials are not orthonormal, and some of their combinations hardly change the
wavefront at all. The combinations taken here are orthonormal over the lit part, piston and tilt removed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.errors import UsageError
from holocal.optics.zernike import zernike, zernike_gradient

Array = NDArray[np.float64]

QUADRATIC = (4, 5, 6)  # Noll: defocus and the two astigmatisms, any quadratic bias


@dataclass(frozen=True)
class LitPupil:
    """Points of the pupil of one zone that light passes: x, y (points,) in pupil radii, weight = intensity there."""

    x: Array
    y: Array
    weight: Array

    def __post_init__(self) -> None:
        shapes = {np.shape(part) for part in (self.x, self.y, self.weight)}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1 or np.size(self.x) < 16:
            raise UsageError(
                f"The lit part of a pupil is given by arrays of shapes {sorted(shapes)}.",
                fix="Give x, y and weight of at least 16 points, each (points,).",
            )
        if not (np.min(self.weight) >= 0 and 0 < np.sum(self.weight) < np.inf):
            raise UsageError("The lit part of a pupil needs weights of 0 or more, one of them above 0.")

    @property
    def share(self) -> Array:
        """The weights over their sum."""
        return np.asarray(self.weight / np.sum(self.weight), np.float64)


def visible_modes(lit: LitPupil, noll: tuple[int, ...], *, dropped_rad: float) -> tuple[Array, Array, float]:
    """Return the combinations (seen, len(noll)) of unit rms over the lit part, their lengths, and what is dropped.

    The length is that of the combination's coefficients; what is dropped has an effect of so many rad rms over the lit
    part if each dropped combination has a length of 1 rad.

    The first is the one with the largest effect. A combination is dropped where coefficients of 1 rad in all (root of
    the sum of squares) change the wavefront over the lit part by less than `dropped_rad` rms. The rows are orthogonal
    in Noll terms too: a sum of them is the vector of minimum norm with its effect.
    """
    root = np.sqrt(lit.share)
    plane = np.stack([np.ones_like(lit.x), lit.x, lit.y], axis=1) * root[:, None]
    waves = zernike(noll, lit.x, lit.y).T * root[:, None]
    waves = waves - plane @ np.linalg.lstsq(plane, waves, rcond=None)[0]
    _, effect, turned = np.linalg.svd(waves, full_matrices=False)
    kept = effect > dropped_rad
    combinations = turned[kept] / effect[kept, None]
    signs = np.sign(combinations[np.arange(len(combinations)), np.abs(combinations).argmax(axis=1)])
    left = float(np.sqrt(np.sum(effect[~kept] ** 2)))
    return np.asarray(combinations * signs[:, None]), np.asarray(1 / effect[kept]), left


def mean_gradient(lit: LitPupil, noll: tuple[int, ...]) -> Array:
    """Return (2, len(noll)) rad per radius per rad: how far each polynomial moves the centroid of the spot."""
    return np.asarray(np.einsum("jpc,p->cj", zernike_gradient(noll, lit.x, lit.y), lit.share))


def spreading_bias(lit: LitPupil, *, gradient_rad: float, steepest: float) -> Array:
    """Return coefficients of Noll 4, 5, 6 whose gradient over the lit part is `gradient_rad` rms along every direction.

    A strip needs much curvature across and little along. The curvature stops at `steepest` rad per radius squared.
    """
    at = np.stack([lit.x, lit.y])
    off = at - (at @ lit.share)[:, None]
    variance, axes = np.linalg.eigh((off * lit.share) @ off.T)
    curvature = np.minimum(gradient_rad / np.sqrt(np.maximum(variance, 1e-12)), steepest)
    q = (axes * curvature) @ axes.T  # the wavefront is (x, y) q (x, y) / 2
    return np.array(
        [(q[0, 0] + q[1, 1]) / (8 * np.sqrt(3)), q[0, 1] / (2 * np.sqrt(6)), (q[0, 0] - q[1, 1]) / (4 * np.sqrt(6))]
    )
