"""The wavefront error of every direction, and what a correction by Zernike coefficients leaves of it.

The correction is that of the procedure `aberration`: Noll 4 to 15 over the nominal pupil in 5 x 5 zones, joined over
the field by Chebyshev polynomials of degree 4 with the same priors. The zones are known without noise here.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.field_model import DEGREE, HIGH, PRIOR_RAD, PRIOR_SHARE, field_terms
from holocal.optics.bench import Array
from holocal.optics.zernike import noll_to_nm, zernike
from holocal.tolerance.arrival import Arrival, without_plane
from holocal.tolerance.design import FIELD, MARGIN, SENT, Design, sent_light

NOLL = tuple(range(4, 16))  # the procedure's noll_max = 15
ZONES = 5
ZONE_RAD = 0.02  # what a zone is known to (docs/physics.md 10): modes that are less than that in its light are not told
FEWEST_ZONES = 3


def zone_rows() -> NDArray[np.bool_]:
    """Return which of the SENT^2 directions are middles of the field's zones, (D,)."""
    line = np.zeros(SENT, np.bool_)
    step = FIELD // ZONES
    line[MARGIN + step // 2 : SENT - MARGIN : step] = True
    return np.outer(line, line).ravel()


def errors(seen: Arrival, design: Design, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the rms over its light of each of the `known` directions (D,), before and after correction, (k,) each.

    Radians, piston and tilt removed; NaN after a correction for which there are too few zones.
    """
    at = np.flatnonzero(known)
    wavefront, amount, pupil_m = seen.wavefront_rad[at], seen.amount[at], sent_light(design).pupil_m[at]
    correction = np.full_like(wavefront, np.nan)
    zones = zone_rows()[at]
    if np.count_nonzero(zones) >= FEWEST_ZONES:
        over_field = field_terms(sent_light(design).field_tan[at], design.half_tan)
        basis = _basis(design)[:, at]
        coefficients = over_field @ _fit(
            wavefront[zones], basis[:, zones], over_field[zones], pupil_m[zones], amount[zones]
        )
        correction = np.einsum("dj,jdn->dn", coefficients, basis)
    both = without_plane(np.stack([wavefront, wavefront - correction]), pupil_m, amount)
    before, after = np.sqrt(np.sum(amount * both**2, axis=-1) / np.maximum(amount.sum(axis=-1), 1e-300))
    return np.asarray(before), np.asarray(after)


def _fit(wavefront: Array, basis: Array, terms: Array, pupil_m: Array, amount: Array) -> Array:
    """Return the coefficients over the field (terms, modes) from zones' wavefronts (z, N), `basis` (modes, z, N)."""
    weight = amount / amount.sum(axis=1, keepdims=True)
    modes, measured = (without_plane(values, pupil_m, weight) for values in (basis, wavefront))
    weighted = modes * weight / ZONE_RAD**2
    information = np.einsum("izn,jzn->zij", weighted, modes, optimize=True)
    normal = np.einsum("zij,zk,zl->ikjl", information, terms, terms, optimize=True)
    right = np.einsum("izn,zn,zk->ik", weighted, measured, terms, optimize=True)
    found = np.linalg.solve(normal.reshape(right.size, right.size) + np.diag(_prior()), right.ravel())
    return np.asarray(found.reshape(right.shape).T)


@lru_cache(maxsize=2)
def _basis(design: Design) -> Array:
    """Return the Zernike polynomials where the nominal light crosses the nominal pupil, (modes, D, N); 0 outside."""
    light = sent_light(design)
    local = light.pupil_m / (design.pupil_diameter_m / 2)
    local = np.where((light.sent > 0)[..., None], local, 0.0)
    return np.asarray(zernike(NOLL, local[..., 0], local[..., 1]))


def _prior() -> Array:
    """Return the precisions of the coefficients over the field, (modes x terms,), as the procedure has them."""
    widths = np.array([PRIOR_RAD[noll_to_nm(j)[0] - 2] for j in NOLL])
    degree = np.array([i + j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])
    shares = np.array([*PRIOR_SHARE, HIGH[-1], HIGH[-1] / 2])[degree]
    return np.asarray(np.outer(widths, shares).ravel() ** -2.0)
