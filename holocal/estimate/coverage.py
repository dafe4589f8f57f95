"""How well intervals cover the truth: whether errors are as large as they are said to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from holocal.errors import InputError

ONE_SIGMA = 0.6826894921370859  # of a Gaussian lies within one sigma


@dataclass(frozen=True)
class Coverage:
    """How often the truth lies within one sigma.

    `fraction` is to be held against `expected` (0.683) with the binomial error `fraction_sigma`; `rms_z` is the root of
    the mean square of (estimate - truth) / sigma, 1 for errors as large as they are said to be; `count` of estimates.
    """

    fraction: float
    fraction_sigma: float
    rms_z: float
    count: int
    expected: float = ONE_SIGMA


def coverage(estimates: ArrayLike, sigmas: ArrayLike, truths: ArrayLike) -> Coverage:
    """Return how well intervals estimate +- sigma cover the truths, all (n,).

    The binomial error is that of (k + 1) / (n + 2), k of n covered, so that it is not 0 where all or none are.

    Raises
    ------
    InputError
        There are no estimates, one is not finite, or a sigma is not above 0.
    """
    estimate, sigma, truth = (np.asarray(a, np.float64).ravel() for a in (estimates, sigmas, truths))
    z = (estimate - truth) / np.where(sigma > 0, sigma, np.nan)
    if z.size == 0 or not np.all(np.isfinite(z)):
        wrong = int(np.count_nonzero(~np.isfinite(z)))
        raise InputError(
            f"Coverage needs estimates, each with a sigma above 0 and a truth: {wrong} of {z.size} are none.",
            fix="Leave out what is not valid.",
            measured=z.size - wrong,
            limit=1,
        )
    inside, count = int(np.count_nonzero(np.abs(z) <= 1)), z.size
    likely = (inside + 1) / (count + 2)
    error = np.sqrt(likely * (1 - likely) / (count + 2))
    return Coverage(inside / count, float(error), float(np.sqrt(np.mean(z**2))), count)
