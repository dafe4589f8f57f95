"""The wavefront of a zone from several frames of its spot: maximum likelihood with nuisances, coarse to fine.

Counts are Poisson plus read noise: the variance of a pixel is read variance + gain x signal + (flicker x signal)^2, as
the pre-flight measured it (photon transfer). Fitted along, each with a prior: amplitude over the pupil (low orders),
where the pupil lies, power and tilt of each frame, the camera's blur. So are wavefront modes above those wanted; left
out they leak into those wanted (docs/physics.md 10).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.spot_model import SpotModel, products
from holocal.estimate.zone_data import Layout, Noise, Priors, ZoneData, ZoneFit
from holocal.optics.bench import Array
from holocal.threads import each

MOST_ITERATIONS, MOST_TRIES = 12, 8
Prior = tuple[Array, Array]  # precision and centre of every parameter

ENOUGH = 0.1  # of chi-square: an iteration that gains less was the last
FORETOLD = 0.2  # of the foretold gain: a step that gains what it should, so nearly, leaves the derivatives as they are


class ZoneProblem:
    """Residuals of a zone's data and their derivatives, for one blur of both."""

    def __init__(self, model: SpotModel, data: ZoneData, noise: Noise, *, amplitude_degree: int = 2) -> None:
        self.model, self.data, self.noise, self.amplitude_degree = model, data, noise, amplitude_degree
        self.terms = len(products(model.degree))
        self.layout = Layout(self.terms, len(products(amplitude_degree)), model.frames)

    def prior(self, priors: Priors, wanted_degree: int) -> Array:
        """Return the precision of every parameter."""
        layout = self.layout
        sd = np.empty(layout.count)
        degrees = np.array([i + j for i, j in products(self.model.degree)])[1:]
        norm = np.array([np.sqrt((2 * i + 1) * (2 * j + 1)) for i, j in products(self.model.degree)])
        sd[layout.wavefront] = np.where(degrees <= wanted_degree, priors.wavefront_rad, priors.higher_rad) * norm[1:]
        sd[layout.wavefront][degrees == 1] = 30.0  # tilt: a spot is known to a pixel or two
        sd[layout.amplitude] = priors.log_amplitude
        sd[layout.amplitude.start] = priors.log_flux
        sd[layout.shift] = 1e3 * priors.shift_m
        sd[layout.power] = priors.log_power
        sd[layout.tilt] = priors.tilt_px
        sd[layout.blur] = priors.blur_px2
        sd[layout.affine] = priors.affine
        return np.asarray(1 / sd**2)

    def expected(self, vector: Array) -> Array:
        """Return the expected counts (frames, rows, columns)."""
        power = self.model.intensity(*self._in_pupil(vector)).cpu().numpy().astype(np.float64)
        return self._moved(vector, power * self._scale(vector))[0]

    def derivatives(self, vector: Array, degree: int) -> tuple[Array, Array]:
        """Return the expected counts, and their derivatives (parameters, frames, rows, columns).

        Those by the wavefront's terms above `degree` are left 0.
        """
        layout, scale = self.layout, self._scale(vector)
        found = self.model.derivatives(*self._in_pupil(vector), degree=max(degree, self.amplitude_degree))
        power, by_products, by_shift = (one.cpu().numpy().astype(np.float64) for one in found)
        expected, slope_x, slope_y, bend, stretch = self._moved(vector, power * scale)
        out = np.zeros((layout.count, *expected.shape))
        terms = by_products.shape[2]
        own = np.concatenate(
            [by_products[:, 0, 1:], by_products[:, 1, : layout.amplitude_terms], 1e-3 * by_shift], axis=1
        )
        own = self._moved(vector, np.moveaxis(own, 1, 0) * scale)[0]
        out[: terms - 1] = own[: terms - 1]
        out[layout.amplitude.start : layout.shift.stop] = own[terms - 1 :]
        for frame in range(1, layout.frames):
            out[layout.power.start + frame - 1, frame] = expected[frame]
            out[layout.tilt.start + 2 * (frame - 1), frame] = -slope_x[frame]
            out[layout.tilt.start + 2 * (frame - 1) + 1, frame] = -slope_y[frame]
        out[layout.blur] = bend
        out[layout.affine] = -stretch
        return expected, out

    def _in_pupil(self, vector: Array) -> tuple[Array, Array, Array]:
        """Return wavefront and log amplitude (terms,) and the pupil's shift in metres."""
        layout = self.layout
        wavefront, amplitude = np.zeros(self.terms), np.zeros(self.terms)
        wavefront[1:] = vector[layout.wavefront]
        amplitude[: layout.amplitude_terms] = vector[layout.amplitude]
        return wavefront, amplitude, vector[layout.shift] * 1e-3

    def _scale(self, vector: Array) -> Array:
        power = np.concatenate([[0.0], vector[self.layout.power]])
        return np.asarray((self.data.scale * np.exp(power))[:, None, None])

    def _moved(self, vector: Array, plain: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return pictures tilted, blurred and stretched to first order, and what each of these is made of."""
        layout = self.layout
        tilt = np.concatenate([np.zeros((1, 2)), vector[layout.tilt].reshape(-1, 2)])[:, :, None, None]
        slope_x, slope_y, bend = _slopes(plain)
        x, y = (np.arange(-half, half + 1.0) for half in self.model.window.half)
        y = -y[:, None]  # rows run down
        stretch = np.stack([slope_x * x, slope_x * y, slope_y * x, slope_y * y])
        moved = plain - tilt[:, 0] * slope_x - tilt[:, 1] * slope_y + vector[layout.blur] * bend
        moved -= np.tensordot(vector[layout.affine], stretch, axes=1)
        curved = np.tensordot(self.model.window.curve, np.stack([x * x + 0 * y, x * y, y * y + 0 * x]), axes=1)
        moved += curved[0] * slope_x + curved[1] * slope_y
        return moved, slope_x, slope_y, bend, stretch

    def start(self) -> Array:
        """Return the vector to begin with: no aberration, and the flux that the data have."""
        vector = np.zeros(self.layout.count)
        expected = self.expected(vector)
        total = float(np.sum(np.where(self.data.good, expected, 0.0)))
        light = float(np.sum(np.where(self.data.good, self.data.counts, 0.0)))
        vector[self.layout.amplitude.start] = 0.5 * np.log(max(light, 1.0) / max(total, 1e-30))
        return vector

    def of_frames(self, frames: tuple[int, ...]) -> ZoneProblem:
        """Return the problem of some of the frames."""
        chosen = list(frames)
        data = ZoneData(self.data.counts[chosen], self.data.good[chosen], self.data.scale[chosen])
        return ZoneProblem(self.model.only(chosen), data, self.noise, amplitude_degree=self.amplitude_degree)

    def begun_at(self, vector: Array, layout: Layout) -> Array:
        """Return a vector of this layout with another's wavefront, amplitude and pupil."""
        start = np.zeros(self.layout.count)
        start[: layout.shift.stop] = vector[: layout.shift.stop]
        return start

    def log_posterior(self, vectors: Array, about: Array, precision: Array) -> Array:
        """Return the logarithm of the posterior (n,) of vectors (n, parameters), but for a constant.

        Pixels' errors are those of the vector `about` (parameters,); `precision` is of the prior round 0.
        """
        prior = (precision, np.zeros(self.layout.count))
        sigma = self._sigma(self.expected(about), None)

        def one(k: int) -> float:
            return -0.5 * self._objective(self.expected(vectors[k]), vectors[k], prior, None, sigma)

        return np.array(each(one, len(vectors)))

    def fit(
        self,
        start: Array,
        precision: Array,
        *,
        centre: Array | None = None,
        blur_px: float = 0.0,
        degree: int | None = None,
    ) -> ZoneFit:
        """Return the most likely parameters by Levenberg and Marquardt's method.

        Parameters
        ----------
        precision, centre
            Of the normal prior; its centre is 0 unless given.
        blur_px
            Data and model are blurred by so much: wide basins first. Tilt, blur and stretch of the frames then wait.
        degree
            Of the wavefront's terms that move; all of them where it is left out.
        """
        kernels = _blur_matrices(self.model.window.shape, blur_px)
        highest = self.model.degree if degree is None else degree
        moving = self._moving(highest, fine=kernels is None)
        vector, damping = start, 1e-3
        prior = (precision, np.zeros(self.layout.count) if centre is None else centre)
        state = self._at(vector, prior, kernels, highest)
        converged = False
        fresh = True
        for _ in range(MOST_ITERATIONS):
            step, value, expected = np.zeros(self.layout.count), np.inf, state.expected
            for _ in range(MOST_TRIES):
                damped = state.matrix[np.ix_(moving, moving)]
                damped = damped + damping * np.diag(np.diag(damped))
                step[moving] = np.linalg.solve(damped, state.right[moving])
                expected = self.expected(vector + step)
                value = self._objective(expected, vector + step, prior, kernels, state.sigma)
                if value < state.objective:
                    break
                damping *= 8
            gain = state.objective - value
            if not gain > 0:
                if not fresh:  # downhill by old derivatives is not downhill: look again
                    state, fresh, damping = self._at(vector, prior, kernels, highest), True, 1e-3
                    continue
                converged = True
                break
            vector, damping = vector + step, max(damping / 6, 1e-7)
            converged = gain < ENOUGH
            foretold = float(2 * step @ state.right - step @ state.matrix @ step)
            fresh = abs(gain - foretold) > FORETOLD * foretold
            if not fresh:
                state = self._moved_on(state, vector, expected, prior, kernels)
            else:
                state = self._at(vector, prior, kernels, highest)
            if converged:
                break
        return self._result(vector, prior, state, converged)

    def _moved_on(
        self, state: _Linearised, vector: Array, expected: Array, prior: Prior, kernels: tuple[Array, Array] | None
    ) -> _Linearised:
        """Return the objective at a vector near by, derivatives and errors as they were."""
        good = self.data.good
        residual = (_blurred(np.where(good, self.data.counts - expected, 0.0), kernels) / state.sigma)[good]
        chi2 = float(residual @ residual)
        right = state.weighted @ residual - prior[0] * (vector - prior[1])
        return replace(state, objective=chi2 + _penalty(vector, prior), right=right, chi2=chi2, expected=expected)

    def _moving(self, highest: int, *, fine: bool) -> NDArray[np.bool_]:
        moving = np.ones(self.layout.count, np.bool_)
        moving[self.layout.wavefront] = np.array([i + j for i, j in products(self.model.degree)])[1:] <= highest
        if not fine:
            moving[self.layout.tilt] = moving[self.layout.blur] = moving[self.layout.affine] = False
        return moving

    def _sigma(self, expected: Array, kernels: tuple[Array, Array] | None) -> Array:
        variance = self.noise.variance(expected) + (self.noise.faint * expected.max(axis=(1, 2), keepdims=True)) ** 2
        if kernels is not None:  # a blurred picture is not fitted to its noise: the brightest pixel's tenth will do
            variance = variance + (0.1 * expected.max(axis=(1, 2), keepdims=True)) ** 2
        return np.asarray(np.sqrt(variance))

    def _objective(
        self, expected: Array, vector: Array, prior: Prior, kernels: tuple[Array, Array] | None, sigma: Array
    ) -> float:
        """Return chi-square with the prior's, for given errors: they follow the model from step to step, not within."""
        difference = _blurred(np.where(self.data.good, self.data.counts - expected, 0.0), kernels)
        residual = (difference / sigma)[self.data.good]
        return float(residual @ residual) + _penalty(vector, prior)

    def _at(self, vector: Array, prior: Prior, kernels: tuple[Array, Array] | None, highest: int) -> _Linearised:
        expected, slopes = self.derivatives(vector, highest)
        sigma, good = self._sigma(expected, kernels), self.data.good
        difference = _blurred(np.where(good, self.data.counts - expected, 0.0), kernels)
        weighted = (_blurred(np.where(good, slopes, 0.0), kernels) / sigma)[:, good]
        residual = (difference / sigma)[good]
        data = weighted @ weighted.T
        return _Linearised(
            float(residual @ residual) + _penalty(vector, prior),
            sigma,
            data + np.diag(prior[0]),
            weighted @ residual - prior[0] * (vector - prior[1]),
            data,
            float(residual @ residual),
            residual.size,
            weighted,
            expected,
        )

    def _result(self, vector: Array, prior: Prior, state: _Linearised, converged: bool) -> ZoneFit:
        layout, own = self.layout, self.layout.wavefront
        others = np.arange(own.stop, layout.count)
        rest, cross = state.matrix[np.ix_(others, others)], state.data[own][:, others]
        information = state.data[own, own] - cross @ np.linalg.solve(rest, cross.T)
        # A last linear step, without the wavefront's own prior: what the data alone want.
        pull = state.right[own] + (prior[0] * (vector - prior[1]))[own]
        weighted = information @ vector[own] + pull - cross @ np.linalg.solve(rest, state.right[others])
        dof = max(state.pixels - layout.count, 1)
        light = float(np.sum(np.where(self.data.good, self.data.counts, 0.0)))
        return ZoneFit(
            layout, vector, np.asarray(np.linalg.inv(state.matrix)), (information + information.T) / 2, weighted,
            state.chi2 / dof, state.pixels, light, converged,
        )  # fmt: skip


@dataclass(frozen=True)
class _Linearised:
    """The objective at a vector, the pixels' errors, the normal equations and the data's own part, and chi-square.

    `weighted` (parameters, pixels) are the derivatives over the errors, `expected` (frames, rows, columns) the counts.
    """

    objective: float
    sigma: Array
    matrix: Array
    right: Array
    data: Array
    chi2: float
    pixels: int
    weighted: Array
    expected: Array


STAGES = ((4.0, 2), (2.0, 3), (1.0, 4))  # blur in pixels, degree of the wavefront


def coarse_to_fine(
    problem: ZoneProblem,
    priors: Priors,
    wanted_degree: int,
    *,
    pupil_m: Array | None = None,
    pupil_sigma_m: float | None = None,
) -> ZoneFit:
    """Return the fit by way of blurred pictures, few modes and two frames, so that large aberrations are caught.

    `pupil_m` (2,) is where the pupil is believed to lie, with an error of `pupil_sigma_m`.
    """
    if pupil_sigma_m is not None:
        priors = replace(priors, shift_m=pupil_sigma_m)
    pair = problem.of_frames((0, 1)) if problem.model.frames > 2 else problem
    vector = pair.start()
    if pupil_m is not None:
        vector[pair.layout.shift] = 1e3 * pupil_m
    middle = np.zeros(pair.layout.count)
    middle[pair.layout.shift] = vector[pair.layout.shift]
    for blur_px, degree in STAGES:
        precision = pair.prior(priors, wanted_degree)
        vector = pair.fit(vector, precision, centre=middle, blur_px=blur_px, degree=degree).vector
    whole = np.zeros(problem.layout.count)
    whole[problem.layout.shift] = middle[pair.layout.shift]
    return problem.fit(problem.begun_at(vector, pair.layout), problem.prior(priors, wanted_degree), centre=whole)


def _penalty(vector: Array, prior: Prior) -> float:
    return float(np.sum(prior[0] * (vector - prior[1]) ** 2))


def _slopes(pictures: Array) -> tuple[Array, Array, Array]:
    """Return d/dx (to the right), d/dy (up) and the Laplacian of pictures (..., rows, columns), per pixel."""
    padded = np.pad(pictures, ((0, 0),) * (pictures.ndim - 2) + ((1, 1), (1, 1)), mode="edge")
    left, right = padded[..., 1:-1, :-2], padded[..., 1:-1, 2:]
    above, below = padded[..., :-2, 1:-1], padded[..., 2:, 1:-1]
    return (right - left) / 2, (above - below) / 2, left + right + above + below - 4 * pictures


def _blur_matrices(shape: tuple[int, int], blur_px: float) -> tuple[Array, Array] | None:
    """Return the matrices that blur rows' and columns' places by a Gaussian; None for no blur."""
    if blur_px <= 0:
        return None
    made = []
    for size in shape:
        at = np.arange(size)
        kernel = np.exp(-0.5 * ((at[:, None] - at) / blur_px) ** 2)
        made.append(kernel / kernel.sum(axis=1, keepdims=True))
    return made[0], made[1]


def _blurred(pictures: Array, kernels: tuple[Array, Array] | None) -> Array:
    return pictures if kernels is None else np.asarray(kernels[0] @ pictures @ kernels[1].T)
