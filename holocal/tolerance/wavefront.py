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


def rms(wavefront_rad: Array, design: Design, amount: Array) -> Array:
    """Return the rms over the light of each direction, (D,) radians, piston and tilt removed; 0 in the dark."""
    light = sent_light(design)
    flat = without_plane(wavefront_rad, light.pupil_m, amount)
    return np.asarray(np.sqrt(np.sum(amount * flat**2, axis=1) / np.maximum(amount.sum(axis=1), 1e-300)))


def corrected(seen: Arrival, design: Design, known: NDArray[np.bool_]) -> Array:
    """Return the wavefronts (D, N) less the correction that the zones among `known` directions (D,) give."""
    at = np.flatnonzero(zone_rows() & known)
    if len(at) < FEWEST_ZONES:
        return seen.wavefront_rad
    light = sent_light(design)
    basis = _basis(design)
    weight = seen.amount[at] / seen.lit[at, None]
    modes = without_plane(basis[:, at], light.pupil_m[at], weight)
    measured = without_plane(seen.wavefront_rad[at], light.pupil_m[at], weight)
    information = np.einsum("izn,jzn,zn->zij", modes, modes, weight, optimize=True) / ZONE_RAD**2
    right = np.einsum("izn,zn->zi", modes, measured * weight) / ZONE_RAD**2
    over_field = field_terms(light.field_tan, design.half_tan)
    terms = over_field[at]
    normal = np.einsum("zij,zk,zl->ikjl", information, terms, terms, optimize=True)
    size = len(NOLL) * over_field.shape[1]
    found = np.linalg.solve(
        normal.reshape(size, size) + np.diag(_prior()), np.einsum("zi,zk->ik", right, terms).ravel()
    )
    coefficients = over_field @ found.reshape(len(NOLL), -1).T
    return np.asarray(seen.wavefront_rad - np.einsum("dj,jdn->dn", coefficients, basis))


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
