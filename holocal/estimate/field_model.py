"""Zernike coefficients over the whole field from the zones' fits, with covariance: every direction has a correction.

A zone sees the wavefront only where its pupil is lit, often a strip: alone it cannot tell astigmatism from defocus.
What it can tell is in its information matrix. All zones are joined by

    c_j(t) = sum_m b_jm F_m(t) + deviation of the zone,        F_m products of Chebyshev polynomials of the tangents t,

a normal prior on b that narrows with the degree, and one on the deviations. How wide the priors of the high degrees
and of the deviations are is found from the data, by the largest evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev, legendre

from holocal.estimate.spot_model import PupilBox, products
from holocal.estimate.zone_data import ZoneFit
from holocal.optics.bench import Array
from holocal.optics.zernike import noll_to_nm, zernike

DEGREE = 4  # over the field; a bench out of line needs 2 (docs/physics.md 10)
# Of a Zernike coefficient of the whole pupil by its radial degree (from 2), and the share by the degree over the field.
PRIOR_RAD, PRIOR_SHARE = (5.0, 1.0, 0.3, 0.1, 0.05), (1.0, 0.7, 0.3)
HIGH = tuple(float(s) for s in np.geomspace(1e-4, 0.03, 5))  # shares of degree 3 over the field; 4 has half of it
DEVIATIONS = tuple(float(s) for s in np.geomspace(1e-4, 4e-3, 4))  # shares, of a zone of its own


@dataclass(frozen=True)
class ZoneEvidence:
    """What a zone says of its Zernike coefficients: `information` (modes, modes) and `information` times estimate."""

    information: Array
    weighted: Array


def modes_of(degree: int) -> tuple[int, ...]:
    """Return all Noll indices of radial orders 2 to `degree`.

    >>> modes_of(3)
    (4, 5, 6, 7, 8, 9, 10)
    """
    return tuple(range(4, (degree + 1) * (degree + 2) // 2 + 1))


def zone_evidence(fit: ZoneFit, box: PupilBox, degree: int, pupil_radius_m: float) -> ZoneEvidence:
    """Return a zone's evidence on the coefficients of `modes_of(degree)`, of the fit's degree; tilt is integrated out.

    All modes of the fit, those above the wanted ones too: over a lit part of the pupil they are not orthogonal, and
    what is left out would leak. The uncertainty is widened by the root of chi2 where that is above 1.
    """
    kept = np.array([i + j >= 2 for i, j in products(degree)[1:]])
    information, weighted = fit.information / max(fit.chi2, 1.0), fit.weighted / max(fit.chi2, 1.0)
    rest = information[np.ix_(~kept, ~kept)] + 1e-9 * np.eye(int(np.count_nonzero(~kept)))
    cross = information[np.ix_(kept, ~kept)]
    own = information[np.ix_(kept, kept)] - cross @ np.linalg.solve(rest, cross.T)
    wanted = weighted[kept] - cross @ np.linalg.solve(rest, weighted[~kept])
    matrix = legendre_of_noll(modes_of(degree), box, degree, pupil_radius_m)[1:][kept]
    return ZoneEvidence(matrix.T @ own @ matrix, matrix.T @ wanted)


def legendre_of_noll(noll: Sequence[int], box: PupilBox, degree: int, pupil_radius_m: float) -> Array:
    """Return the Legendre coefficients (terms, modes) over a box of Zernike polynomials of the whole pupil; exact."""
    node, weight = legendre.leggauss(degree + 8)
    x, y = box.centre_m[0] + node * box.half_m[0], box.centre_m[1] + node * box.half_m[1]
    q = np.stack(np.meshgrid(x, y), axis=-1) @ box.to_pupil / pupil_radius_m
    values = zernike(noll, q[..., 0], q[..., 1])  # (modes, y, x)
    table = legendre.legvander(node, degree) * (2 * np.arange(degree + 1) + 1) / 2
    found = np.einsum("myx,xi,yj,x,y->mij", values, table, table, weight, weight, optimize=True)
    return np.stack([found[:, i, j] for i, j in products(degree)])


@dataclass(frozen=True)
class FieldModel:
    """The coefficients over the field.

    `coefficients` (modes, terms) b; `zones` (zones, modes) posterior means, deviations included, with `zone_covariance`
    (zones, modes, modes); `predicted` (zones, modes) what all *other* zones say of each, with `predicted_covariance`.
    `half_tan` scales the tangents. `high` and `deviation` are the priors' shares that were found.
    """

    noll: tuple[int, ...]
    half_tan: tuple[float, float]
    coefficients: Array
    zones: Array
    zone_covariance: Array
    predicted: Array
    predicted_covariance: Array
    high: float
    deviation: float

    def only(self, noll: Sequence[int]) -> FieldModel:
        """Return the model of some of the modes."""
        at = [self.noll.index(j) for j in noll]
        return replace(
            self,
            noll=tuple(noll),
            coefficients=self.coefficients[at],
            zones=self.zones[:, at],
            zone_covariance=self.zone_covariance[:, at][:, :, at],
            predicted=self.predicted[:, at],
            predicted_covariance=self.predicted_covariance[:, at][:, :, at],
        )

    def at(self, field_tan: Array) -> Array:
        """Return the smooth part of the coefficients, (n, modes) radians, at tangents (n, 2)."""
        return field_terms(field_tan, self.half_tan) @ self.coefficients.T


def field_terms(field_tan: Array, half_tan: tuple[float, float], degree: int = DEGREE) -> Array:
    """Return F_m at tangents (n, 2), (n, terms): total degree up to `degree`, the field's edges held."""
    x, y = (np.clip(field_tan[:, axis] / half_tan[axis], -1, 1) for axis in (0, 1))
    in_x, in_y = chebyshev.chebvander(x, degree), chebyshev.chebvander(y, degree)
    return np.stack([in_x[:, i] * in_y[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)


def fit_field(
    evidence: Sequence[ZoneEvidence | None], field_tan: Array, half_tan: tuple[float, float], noll: Sequence[int]
) -> FieldModel:
    """Return the field's model from zones at tangents (zones, 2); None stands for a zone that says nothing."""
    problem = _Problem(evidence, field_tan, half_tan, noll)
    best = max(((problem.evidence(h, d), h, d) for h in HIGH for d in DEVIATIONS), key=lambda found: found[0])
    _, high, deviation = best
    mean, covariance = problem.solve(high, deviation)
    modes, terms = problem.modes, problem.terms
    zones, spread = problem.zones_of(mean, covariance)
    predicted, predicted_covariance = zones.copy(), spread.copy()
    for z, said in enumerate(evidence):
        if said is not None:
            # What is left without the zone's own part: Woodbury's formula for taking it away again.
            taken = np.linalg.inv(np.eye(modes) - spread[z] @ said.information)
            predicted[z] = taken @ (zones[z] - spread[z] @ said.weighted)
            predicted_covariance[z] = taken @ spread[z]
    return FieldModel(
        tuple(noll),
        half_tan,
        mean[: modes * terms].reshape(modes, terms),
        zones,
        spread,
        predicted,
        predicted_covariance,
        high,
        deviation,
    )


class _Problem:
    """The normal equations of b and of each zone's coefficients c_z = F b + deviation, b first."""

    def __init__(
        self,
        evidence: Sequence[ZoneEvidence | None],
        field_tan: Array,
        half_tan: tuple[float, float],
        noll: Sequence[int],
    ) -> None:
        self.said, self.modes = evidence, len(noll)
        modes = self.modes
        radial = np.array([min(noll_to_nm(j)[0], len(PRIOR_RAD) + 1) for j in noll])
        self.widths = np.array(PRIOR_RAD)[radial - 2]
        self.basis = field_terms(field_tan, half_tan)
        self.terms = self.basis.shape[1]
        self.degree = np.array([i + j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])
        # of the data on b and the deviations e_z: c_z = (I x F_z) b + e_z
        size = modes * self.terms
        self.size = size + modes * len(evidence)
        self.information, self.weighted = np.zeros((self.size, self.size)), np.zeros(self.size)
        for z, one in enumerate(evidence):
            if one is not None:
                self._add(self.information, self.weighted, z, one)

    def _places(self, z: int) -> tuple[Array, slice]:
        """Return d c_z / d b (modes, modes x terms), and where the zone's deviations stand."""
        start = self.modes * self.terms + z * self.modes
        return np.kron(np.eye(self.modes), self.basis[z]), slice(start, start + self.modes)

    def _add(self, information: Array, weighted: Array, z: int, one: ZoneEvidence, sign: float = 1.0) -> None:
        spread, own = self._places(z)
        size = self.modes * self.terms
        cross = spread.T @ one.information
        information[:size, :size] += sign * (cross @ spread)
        information[:size, own] += sign * cross
        information[own, :size] += sign * cross.T
        information[own, own] += sign * one.information
        weighted[:size] += sign * (spread.T @ one.weighted)
        weighted[own] += sign * one.weighted

    def _prior(self, high: float, deviation: float) -> Array:
        """Return the precisions of b and the deviations; `high` and `deviation` are shares of a mode's own width."""
        over_field = np.array([*PRIOR_SHARE, high, high / 2])[self.degree]
        own = np.outer(self.widths, over_field).ravel() ** -2
        return np.concatenate([own, np.tile((deviation * self.widths) ** -2.0, len(self.said))])

    def evidence(self, high: float, deviation: float) -> float:
        """Return the logarithm of the marginal likelihood of the priors' widths, up to a constant."""
        prior = self._prior(high, deviation)
        factor = np.linalg.cholesky(self.information + np.diag(prior))
        half = np.linalg.solve(factor, self.weighted)
        return float(0.5 * np.sum(np.log(prior)) - np.sum(np.log(np.diag(factor))) + 0.5 * half @ half)

    def solve(self, high: float, deviation: float) -> tuple[Array, Array]:
        """Return mean and covariance of b and the deviations."""
        covariance = np.linalg.inv(self.information + np.diag(self._prior(high, deviation)))
        return np.asarray(covariance @ self.weighted), np.asarray(covariance)

    def zones_of(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Return every zone's coefficients (zones, modes) and their covariance (zones, modes, modes)."""
        means, spreads = [], []
        for z in range(len(self.said)):
            spread, own = self._places(z)
            matrix = np.zeros((self.modes, self.size))
            matrix[:, : spread.shape[1]] = spread
            matrix[:, own] = np.eye(self.modes)
            means.append(matrix @ mean)
            spreads.append(matrix @ covariance @ matrix.T)
        return np.array(means), np.array(spreads)
