"""The posterior of beam and displacements by sampling: emcee on the second order of the ray trace round the fit.

A chain takes 20,000 log-probabilities; a ray trace of all spots 25 ms. Round the fit the middles are quadratic in the
displacements, over the whole posterior but for one direction: the mirror is a surface of revolution, and turned about
its own axis it gives the same picture, so that nothing but the prior limits that turn. The chain therefore stays across
it, and every sample is then turned by an angle drawn from the prior along its orbit. Rays traced at places of the chain
say how well the second order does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.bench_pose import TAIL, residual_scale, spun
from holocal.estimate.posterior import LaplaceFit, sample_posterior
from procedures._aberration_spots import nominal_bench
from procedures._bench_light import NUISANCE, SpotData

if TYPE_CHECKING:
    from procedures.alignment import State

Array = NDArray[np.float64]

CROSSED = 8  # of the least known directions: those along which the middles bend most
CHECKED = 24  # places of the chain where the exact rays are traced
SPIN_STEP = 1e-4  # radians, of its direction
SPIN_RANGE, SPINS = 0.14, 2001  # radians and steps of the mirror's turn about its own axis: 8 degrees, eight priors


class Quadratic:
    """The log-probability round a fit, by the second order of the middles along `axes` (p, d) from it.

    Columns of `axes` are a standard deviation each, the largest last. Places are coordinates u (n, d): the parameters
    are fit + axes v, v = u + a form of second order in u that takes back what the bend of the middles along one axis
    does to the others, better known by far; without it the posterior is a crescent that no Gaussian proposal finds.
    """

    def __init__(self, data: SpotData, values: Array, axes: Array, prior: Array) -> None:
        self._data, self._prior, self._values, self._axes = data, prior, values, axes
        predict, count = data.model.places_px, axes.shape[1]
        middle = predict(values)
        ahead = np.stack([predict(values + axis) for axis in axes.T])
        behind = np.stack([predict(values - axis) for axis in axes.T])
        weak = range(max(count - CROSSED, 0), count)
        crossed = [(i, j) for i in weak for j in weak if i < j]
        self._pairs = np.array([(i, i) for i in range(count)] + crossed)
        bends = [
            *((ahead + behind) / 2 - middle),
            *(predict(values + axes[:, i] + axes[:, j]) - ahead[i] - ahead[j] + middle for i, j in crossed),
        ]
        off = (data.middles_px - middle) / data.sigma_px
        slope, bend = ((ahead - behind) / 2) / data.sigma_px, np.stack(bends) / data.sigma_px
        self._used = np.isfinite(off) & np.isfinite(slope).all(axis=0) & np.isfinite(bend).all(axis=0)
        self._off, self._slope, bend = off[self._used], slope[:, self._used], bend[:, self._used]
        self.scale = residual_scale(self._off)
        weight = (TAIL + 1) / (TAIL + (self._off / self.scale) ** 2) / self.scale**2
        self._back = -(bend * weight) @ self._slope.T  # (pairs, d)
        self._bend = bend + self._back @ self._slope

    def log_probability(self, places: Array) -> Array:
        """Return the log-probability of places (n, d), (n,), up to a constant."""
        squares = places[:, self._pairs[:, 0]] * places[:, self._pairs[:, 1]]
        return self._of(self._off - places @ self._slope - squares @ self._bend, places)

    def exact(self, places: Array) -> Array:
        """Return the same by rays, place by place."""
        predict = self._data.model.places_px
        off = np.stack([self._data.middles_px - predict(one) for one in self.values_at(places)]) / self._data.sigma_px
        return self._of(off[:, self._used], places)

    def values_at(self, places: Array) -> Array:
        """Return the parameters (n, p) at places."""
        squares = places[:, self._pairs[:, 0]] * places[:, self._pairs[:, 1]]
        return np.asarray(self._values + (places + squares @ self._back) @ self._axes.T)

    def _of(self, off: Array, places: Array) -> Array:
        square = (off / self.scale) ** 2
        like = -0.5 * (TAIL + 1) * np.sum(np.log1p(square / TAIL), axis=1)
        return np.asarray(
            like - 0.5 * np.sum((self.values_at(places) / self._prior) ** 2, axis=1) + self._volume(places)
        )

    def _volume(self, places: Array) -> Array:
        """Return log |dv / du| at places, (n,)."""
        count = places.shape[1]
        unit = np.eye(count)
        first, second = self._pairs.T
        grown = unit[first] * places[:, second, None] + unit[second] * places[:, first, None]  # (n, pairs, d)
        return np.asarray(np.linalg.slogdet(unit + np.einsum("qa,nqb->nab", self._back, grown))[1])


@dataclass(frozen=True)
class PosePosterior:
    """Samples (k, 12) of the displacements, and their covariance (12, 12); `across` (p, p) is that of beam and
    displacements without the mirror's turn about its own axis; `said` is what the chain says of itself."""

    samples: Array
    covariance: Array
    across: Array
    said: dict[str, Any]


def posterior_of(state: State, data: SpotData, prior: Array) -> PosePosterior:
    """Return the posterior of the displacements, the beam marginalised."""
    axes = _across_the_spin(state, prior)
    quadratic = Quadratic(data, state.values, axes, prior)
    count = axes.shape[1]
    chain = sample_posterior(
        quadratic.log_probability, LaplaceFit(np.zeros(count), np.eye(count)), seed=state.spots.seed
    )
    rng = np.random.default_rng([state.spots.seed, CHECKED])
    samples = quadratic.values_at(chain.samples if len(chain.samples) else rng.standard_normal((1000, count)))
    chosen = quadratic.values_at(places := chain.samples[:: max(1, len(chain.samples) // CHECKED)][:CHECKED])
    off = quadratic.exact(places) - quadratic.log_probability(places) if len(chosen) else np.zeros(1)
    turned = _spun(state, samples[:, len(NUISANCE) :], prior[len(NUISANCE) :], rng)
    said = {
        "dimensions": count,
        "converged": chain.converged,
        "reason": chain.reason,
        "acceptance": chain.acceptance,
        "autocorrelation_steps": float(np.max(chain.autocorrelation_steps)) if chain.converged else None,
        "effective_samples": chain.effective_samples,
        "sigma_ratio": {"least": float(np.min(chain.sigma_ratio)), "most": float(np.max(chain.sigma_ratio))},
        "calls": chain.calls,
        "log_probability_off": float(np.std(off)),
    }
    across = axes @ chain.covariance @ axes.T
    return PosePosterior(turned, np.cov(turned.T), across, said)


def _across_the_spin(state: State, prior: Array) -> Array:
    """Return standard deviations of the posterior (p, p - 1), column by column, the least first, across the spin."""
    nominal, pose = nominal_bench(state.facts), state.values[len(NUISANCE) :]
    ahead, behind = spun(nominal, pose, np.array([SPIN_STEP, -SPIN_STEP]))
    spin = np.concatenate([np.zeros(len(NUISANCE)), ahead - behind]) / prior
    precision = prior[:, None] * state.information * prior + np.eye(len(prior))
    basis = np.linalg.svd((spin / np.linalg.norm(spin))[None])[2][1:].T
    strength, vectors = np.linalg.eigh(basis.T @ precision @ basis)
    return np.asarray(prior[:, None] * (basis @ vectors / np.sqrt(strength))[:, ::-1])


def _spun(state: State, poses: Array, prior: Array, rng: np.random.Generator) -> Array:
    """Return the poses (k, 12), each turned about the mirror's axis by an angle drawn from the prior on its orbit."""
    nominal = nominal_bench(state.facts)
    angles = np.linspace(-SPIN_RANGE, SPIN_RANGE, SPINS)
    orbit = spun(nominal, poses.mean(axis=0), angles)
    weight = np.exp(-0.5 * np.sum((orbit / prior) ** 2, axis=1) + 0.5 * np.min(np.sum((orbit / prior) ** 2, axis=1)))
    drawn = rng.choice(angles, size=len(poses), p=weight / weight.sum()) + rng.uniform(-0.5, 0.5, len(poses)) * (
        angles[1] - angles[0]
    )
    return np.stack([spun(nominal, pose, np.array([angle]))[0] for pose, angle in zip(poses, drawn, strict=True)])
