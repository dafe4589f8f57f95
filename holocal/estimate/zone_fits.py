"""The wavefronts of all zones: each by itself, then those again whose pupil the others place elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holocal.estimate.spot_fit import ZoneProblem, coarse_to_fine
from holocal.estimate.zone_data import Priors, ZoneFit
from holocal.optics.bench import Array
from holocal.threads import each

SURE_M = 1e-4  # a zone knows where the pupil lies if its own error is below this
OFF_M = 1.5e-4  # a zone whose pupil lies farther from the others' is fitted again
TOGETHER_M = 8e-5  # prior round the others' place: it differs over the field by as much
POOR = 2.0  # times the median chi-square

Problems = Sequence[ZoneProblem | None]


def fit_zones(
    problems: Problems, priors: Priors, wanted_degree: int, started: Sequence[Array | None] | None = None
) -> list[ZoneFit | None]:
    """Return the zones' fits, None where there is no problem.

    `started` gives vectors near the solution: no coarse stage is then needed.
    """
    begun = [None] * len(problems) if started is None else list(started)

    def first(zone: int) -> ZoneFit | None:
        problem, start = problems[zone], begun[zone]
        if problem is None:
            return None
        if start is not None:
            return problem.fit(start, problem.prior(priors, wanted_degree))
        return coarse_to_fine(problem, priors, wanted_degree)

    fits = each(first, len(problems))
    place = pupil_place(fits)
    if place is None:
        return fits
    typical = float(np.median([fit.chi2 for fit in fits if fit is not None]))

    def again(zone: int) -> ZoneFit | None:
        problem, fit = problems[zone], fits[zone]
        if problem is None or fit is None:
            return fit
        off = np.linalg.norm(1e-3 * fit.vector[fit.layout.shift] - place)
        if off <= OFF_M and fit.chi2 <= POOR * max(typical, 1.0):
            return fit
        near = coarse_to_fine(problem, priors, wanted_degree, pupil_m=place, pupil_sigma_m=TOGETHER_M)
        unsure = _pupil_sigma_m(fit) > SURE_M
        return near if unsure or near.chi2 < fit.chi2 * 1.05 else fit

    return each(again, len(problems))


def pupil_place(fits: Sequence[ZoneFit | None]) -> Array | None:
    """Return where the pupil lies, (2,) metres: the median of the zones that can tell; None where none can."""
    known = [fit for fit in fits if fit is not None and _pupil_sigma_m(fit) < SURE_M]
    if not known:
        return None
    best = float(np.median([fit.chi2 for fit in known]))
    places = [1e-3 * fit.vector[fit.layout.shift] for fit in known if fit.chi2 <= POOR * max(best, 1.0)]
    return np.asarray(np.median(places, axis=0))


def _pupil_sigma_m(fit: ZoneFit) -> float:
    return 1e-3 * float(np.sqrt(np.max(np.diag(fit.covariance)[fit.layout.shift]) * max(fit.chi2, 1.0)))
