"""The posterior of one zone's wavefront by sampling: a test of the Laplace errors that every number here comes with."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.field_model import legendre_of_noll
from holocal.estimate.posterior import LaplaceFit, sample_posterior
from holocal.estimate.zone_data import Priors
from holocal.loop.procedure import Figure
from holocal.optics.zernike import noll_to_nm
from procedures._aberration_light import array_of
from procedures._aberration_zones import Estimate

if TYPE_CHECKING:
    from procedures._aberration_model import State

Array = NDArray[np.float64]


def posterior_of_zone(state: State, found: Estimate) -> tuple[Figure, dict[str, Any]] | None:
    """Return the corner plot of the best lit of the believed zones, and what the chain says of itself.

    All parameters of the zone's pictures are sampled, the nuisances too; shown are the Noll coefficients over the
    smallest disc round the zone's light, from this zone's pictures alone: over the whole pupil a strip of it says
    nothing of one coefficient without the others. What the field's other zones add is not in them.
    """
    array, noll = array_of(state), state.parameters.noll
    known = np.flatnonzero(found.valid)
    if not len(known):
        return None
    zone = int(known[np.argmax(array.lit[known])])
    fit, problem, box = found.fits[zone], found.problems[zone], found.boxes[zone]
    if fit is None or problem is None or box is None:
        return None
    wanted = max(noll_to_nm(j)[0] for j in noll)
    precision = problem.prior(replace(Priors(), affine=found.affine), wanted)
    own = np.zeros(fit.layout.count, np.bool_)
    own[fit.layout.wavefront] = True
    chain = sample_posterior(
        lambda places: problem.log_posterior(places, fit.vector, precision),
        LaplaceFit(fit.vector, fit.covariance),
        seed=state.seed,
        reported=own,
    )
    # Legendre products of a total degree and as many Noll modes span the same polynomials.
    radius_m = float(np.max(array.half_m[zone]))
    centre = box.centre_m - array.centre_m[zone] @ np.linalg.inv(box.to_pupil)
    there = replace(box, centre_m=(float(centre[0]), float(centre[1])))
    modes = legendre_of_noll(range(1, problem.terms + 1), there, found.degree, radius_m)
    to_noll = np.linalg.inv(modes)[[j - 1 for j in noll]][:, 1:]
    tangent = np.degrees(np.arctan(array.field_tan[zone]))
    said = {
        "zone": zone,
        "dimensions": int(fit.layout.count),
        "converged": chain.converged,
        "reason": chain.reason,
        "acceptance": chain.acceptance,
        "autocorrelation_steps": float(np.max(chain.autocorrelation_steps)) if chain.converged else None,
        "effective_samples": chain.effective_samples,
        "sigma_ratio": {"least": float(np.min(chain.sigma_ratio)), "most": float(np.max(chain.sigma_ratio))},
        "calls": chain.calls,
    }
    caption = (
        f"All {fit.layout.count} parameters of this zone's {len(state.pictures)} pictures, nuisances too, sampled by "
        "emcee; the other zones, which narrow this, are left out. Lines: the Laplace fit."
    )
    caption += (
        f" {chain.acceptance:.0%} of the proposals were taken; the chain forgets within "
        f"{np.max(chain.autocorrelation_steps):.1f} steps."
        if chain.converged
        else f" Not to be trusted: {chain.reason}"
    )
    figure = Figure(
        "posterior",
        f"Coefficients of the zone at {tangent[0]:.1f}, {tangent[1]:.1f} degrees, over {2e3 * radius_m:.2f} mm",
        "corner",
        {
            "samples": chain.samples @ to_noll.T,
            "laplace_mean": to_noll @ fit.vector[fit.layout.wavefront],
            "laplace_covariance": to_noll @ fit.covariance[fit.layout.wavefront, fit.layout.wavefront] @ to_noll.T,
        },
        "rad",
        caption,
        labels=tuple(f"Noll {j}" for j in noll),
    )
    return figure, said
