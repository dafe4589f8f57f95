"""Phase steps that nobody knows, from the fringe that every camera pixel sees: phase-shifting interferometry, inverted.

A frame shows one level on a fixed set of the panel's pixels and always the same on all others. The field at a camera
pixel is then a + b exp(i D), and its brightness, whatever the optics, the speckle and the pixel's area,

    I_fp = g_f (A_p + C_p cos D_f + S_p sin D_f)                                   D_f the phase of the frame's level

Speckle gives every pixel a fringe of its own, so the frames lie on a cone in the three dimensions of (A, C, S), and a
few thousand pixels fix it. Start: the three largest singular vectors, an ellipse through them (Vargas, Quiroga and
Belenguer 2011, doi 10.1364/OL.36.001326). End: least squares over phases and gains with the pixels' A, C, S eliminated
(the likelihood that the iterations of Wang and Han, doi 10.1364/OL.29.001671, climb), weights from the noise.

The gains cannot be told from the cone alone: a Lorentz boost turns it into itself with other phases and gains. They are
held by a prior, that the source drifts in time, while the levels come in no order of time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNKNOWN_RAD = float(np.pi / np.sqrt(3))  # the standard deviation of a phase of which nothing is known
FEWEST_LEVELS = 6  # an ellipse has five parameters
FEWEST_PIXELS = 12
LEAST_FRINGE = 5.0  # standard errors by which the weaker of the two fringe components must stand out
MOST_ITERATIONS = 30
SMALL_STEP_RAD = 1e-5
ROUNDING_VAR = 1 / 12  # squared counts
RIDGE = 1e-10  # of a normal matrix's trace: keeps it positive where phases fill a small arc


@dataclass(frozen=True)
class Noise:
    """What a pixel's counts scatter by: variance = `read_var` + `per_count` x counts, in squared counts."""

    read_var: float
    per_count: float

    def variance(self, counts: Array) -> Array:
        """Return the variance of counts; never below that of rounding to whole counts, whatever a model says."""
        return np.asarray(np.maximum(self.read_var + self.per_count * np.maximum(counts, 0.0), ROUNDING_VAR))


@dataclass(frozen=True)
class Drift:
    """How the source drifts, relative: a random walk of `walk_var` per frame, and `white_var` in each frame alone."""

    walk_var: float = 1e-8
    white_var: float = 1e-8

    def covariance(self, times: Array) -> Array:
        """Return the covariance (n, n) of the logarithms of the gains; their mean is unknown."""
        walk = np.minimum(times[:, None], times[None, :]) - times.min()
        return np.asarray(1.0 + self.walk_var * walk + self.white_var * np.eye(len(times)))


@dataclass(frozen=True)
class Fringes:
    """The phases of levels.

    `levels` (k,) ascending, `phase_rad` (k,) with 0 at the first, `covariance` (k, k) of them, `gains` (frames,) about
    1; `pixels` (3, n) the fringes A, C, S of all pixels; `kept` (n,) those that the fit used; `chi2` the squared
    residuals over their variance per degree of freedom, which the covariance already carries where it is above 1.
    Not `valid`: nothing was found, for the `reason`; phases are then 0 and their standard error that of no knowledge.
    """

    levels: NDArray[np.int64]
    phase_rad: Array
    covariance: Array
    gains: Array
    pixels: Array
    kept: NDArray[np.bool_]
    chi2: float
    valid: bool
    reason: str = ""

    @property
    def sigma_rad(self) -> Array:
        """The standard error of each phase against the first one's."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_fringes(
    counts: Array, level_of: NDArray[np.int64], *, noise: Noise, drift: Drift, times: Array | None = None
) -> Fringes:
    """Return the phases of the levels of frames, their sign such that the phase rises from the first to the last.

    Parameters
    ----------
    counts
        (frames, n) of n camera pixels, dark level subtracted.
    level_of
        (frames,) the level that each frame showed. Frames of one level share a phase.
    noise
        Of a pixel in a frame.
    drift
        Of the source.
    times
        (frames,) when each frame was taken, in frames; default 0, 1, 2, ...
    """
    frames, n = counts.shape
    levels, which = np.unique(level_of, return_inverse=True)
    when = np.arange(frames, dtype=np.float64) if times is None else times

    def nothing(reason: str) -> Fringes:
        k = len(levels)
        unknown = UNKNOWN_RAD**2 * np.eye(k)
        kept = np.zeros(n, bool)
        return Fringes(
            levels, np.zeros(k), unknown, np.ones(frames), np.zeros((3, n)), kept, float("inf"), False, reason
        )

    if len(levels) < FEWEST_LEVELS or n < FEWEST_PIXELS:
        return nothing(f"{len(levels)} levels and {n} pixels; {FEWEST_LEVELS} and {FEWEST_PIXELS} are needed")
    kept = np.all(np.isfinite(counts), axis=0) & (counts.mean(axis=0) > 0)
    if np.count_nonzero(kept) < FEWEST_PIXELS:
        return nothing(f"{np.count_nonzero(kept)} pixels hold light; {FEWEST_PIXELS} are needed")
    fitted: _Fit | None = None
    for _ in range(3):  # a fringe that fits ill is a hot pixel or a clipped one; without it the others fit better
        start = _by_ellipse(counts[:, kept], noise)
        if start is None:
            return nothing("the fringes do not stand out of the noise")
        prior = np.asarray(np.linalg.inv(drift.covariance(when)), np.float64)
        fitted = _refined(counts[:, kept], which, *start, noise=noise, prior=prior)
        if fitted is None:
            return nothing("the fit of phases and gains does not settle")
        bad = _outliers(fitted.pixel_chi2, frames - 3)
        if not bad.any():
            break
        kept[np.flatnonzero(kept)[bad]] = False
        if np.count_nonzero(kept) < FEWEST_PIXELS:
            return nothing("too few pixels follow a fringe")
    assert fitted is not None
    return _as_fringes(levels, fitted, counts, kept, which, noise)


@dataclass(frozen=True)
class _Fit:
    """Phases (k,), logarithms of gains (frames,), the covariance of the phases, chi2 per pixel and in all."""

    phase: Array
    log_gain: Array
    covariance: Array
    pixel_chi2: Array
    chi2: float


def _by_ellipse(counts: Array, noise: Noise) -> tuple[Array, Array] | None:
    """Return a first guess of each frame's phase and logarithm of gain, or None where no fringe is seen."""
    scaled = counts / np.sqrt(noise.variance(counts.mean(axis=0)))
    left, strength, _ = np.linalg.svd(scaled, full_matrices=False)
    # White noise of unit variance has singular values up to about sqrt(n) + sqrt(frames).
    edge = np.sqrt(counts.shape[1]) + np.sqrt(counts.shape[0])
    if strength[2] ** 2 < edge**2 * (1 + LEAST_FRINGE / np.sqrt(counts.shape[1])):
        return None
    frames = left[:, :3] * strength[:3]
    to_one, *_ = np.linalg.lstsq(frames, np.ones(len(frames)), rcond=None)  # the source is nearly steady
    gains = frames @ to_one
    if not np.all(gains > 0):
        return None
    across = np.linalg.svd(to_one[None])[2][1:]
    plane = frames @ across.T / gains[:, None]
    return _on_a_circle(plane), np.log(gains)


def _on_a_circle(points: Array) -> Array:
    """Return the angles of points (n, 2) on the ellipse that fits them best, as seen when it is made a circle.

    Halir and Flusser's form of the direct fit by Fitzgibbon et al. (doi 10.1109/34.765658): always an ellipse.
    """
    middle, size = points.mean(axis=0), points.std(axis=0)
    x, y = ((points - middle) / size).T
    quadratic, linear = np.stack([x * x, x * y, y * y], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    scatter = linear.T @ linear
    to_linear = -np.linalg.solve(scatter, linear.T @ quadratic)
    reduced = quadratic.T @ quadratic + quadratic.T @ linear @ to_linear
    reduced = np.stack([reduced[2] / 2, -reduced[1], reduced[0] / 2])
    _, vectors = np.linalg.eig(reduced)
    vectors = np.real(vectors)
    a, b, c = vectors[:, int(np.argmax(4 * vectors[0] * vectors[2] - vectors[1] ** 2))]
    d, e, _ = to_linear @ np.array([a, b, c])
    form = np.array([[a, b / 2], [b / 2, c]])
    centre = -0.5 * np.linalg.solve(form, [d, e])
    if form[0, 0] < 0:
        form = -form
    round_ = (np.stack([x, y], axis=1) - centre) @ np.linalg.cholesky(form)
    return np.asarray(np.arctan2(round_[:, 1], round_[:, 0]))


def _refined(
    counts: Array, which: NDArray[np.int64], angle: Array, log_gain: Array, *, noise: Noise, prior: Array
) -> _Fit | None:
    """Return the most likely phases and gains near a guess, by Gauss-Newton with the pixels' fringes eliminated."""
    frames, n = counts.shape
    k = int(which.max()) + 1
    to_level = np.zeros((frames, k))
    to_level[np.arange(frames), which] = 1.0
    phasor = to_level.T @ np.exp(1j * angle)
    phase = np.angle(phasor * np.conj(phasor[0]))
    spread = np.zeros((2 * frames, k + frames))  # from the parameters of all frames to those that are free
    spread[:frames, :k], spread[frames:, k:] = to_level, np.eye(frames)
    spread = spread[:, 1:]  # the first level's phase is 0
    held = np.zeros((k + frames - 1, k + frames - 1))
    held[k - 1 :, k - 1 :] = prior
    weight = 1 / noise.variance(counts.mean(axis=0) * np.ones((frames, 1)))
    for iteration in range(MOST_ITERATIONS):
        try:
            hessian, gradient, residual, model = _profiled(counts, _basis(phase[which], log_gain), weight)
            pull = spread.T @ gradient
            pull[k - 1 :] -= prior @ log_gain
            covariance = np.linalg.inv(spread.T @ hessian @ spread + held)
        except np.linalg.LinAlgError:  # phases that have run together: no circle is left to tell fringes by
            return None
        step = covariance @ pull
        step *= min(1.0, 0.5 / float(np.abs(step).max() + 1e-300))
        phase = phase + np.concatenate([[0.0], step[: k - 1]])
        log_gain = log_gain + step[k - 1 :]
        weight = 1 / noise.variance(model)
        if not np.all(np.isfinite(step)):
            return None
        if iteration > 1 and np.abs(step).max() < SMALL_STEP_RAD:
            break
    else:
        return None
    squared = weight * residual**2
    free = frames * n - 3 * n - (k + frames - 2)
    chi2 = float(squared.sum() / max(free, 1))
    within = np.zeros((k, k))
    within[1:, 1:] = covariance[: k - 1, : k - 1]
    return _Fit(phase, log_gain, within, squared.sum(axis=0), chi2)


def _basis(phase: Array, log_gain: Array) -> Array:
    return np.asarray(np.exp(log_gain)[:, None] * np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1))


def _pixels(counts: Array, basis: Array, weight: Array) -> tuple[Array, Array]:
    """Return every pixel's fringe (3, n), and the inverse (n, 3, 3) of its normal matrix."""
    normal = np.einsum("fi,fp,fj->pij", basis, weight, basis, optimize=True)
    inverse = np.linalg.inv(normal + RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3))
    return np.asarray(np.einsum("pij,jp->ip", inverse, basis.T @ (weight * counts))), np.asarray(inverse)


def _profiled(counts: Array, basis: Array, weight: Array) -> tuple[Array, Array, Array, Array]:
    """Return information and gradient for (phase, log gain) of every frame, the fringes eliminated; residual, model."""
    fringes, inverse = _pixels(counts, basis, weight)
    model = basis @ fringes
    residual = counts - model
    turned = np.stack([np.zeros(len(basis)), -basis[:, 2], basis[:, 1]], axis=1) @ fringes  # d model / d phase
    columns = np.stack([turned, model])  # (2, frames, n): what the model changes by
    weighted = columns * weight
    frames = len(basis)
    information = np.zeros((2 * frames, 2 * frames))
    own = np.einsum("afp,bfp->abf", weighted, columns)
    for a in range(2):
        for b in range(2):
            information[a * frames : (a + 1) * frames, b * frames : (b + 1) * frames] = np.diag(own[a, b])
    mixed = (weighted[..., None] * basis[None, :, None, :]).reshape(2 * frames, -1, 3)
    factor = np.linalg.cholesky(inverse)
    taken = np.einsum("fpi,pij->fpj", mixed, factor, optimize=True).reshape(2 * frames, -1)
    information -= taken @ taken.T
    gradient = np.sum(weighted * residual, axis=-1).ravel()
    return information, gradient, residual, model


def _outliers(pixel_chi2: Array, freedom: int) -> NDArray[np.bool_]:
    """Return the pixels that fit far worse than most: their chi2 is beyond 6 standard deviations of the median's."""
    typical = float(np.median(pixel_chi2))
    return np.asarray(pixel_chi2 > typical * (1 + 6 * np.sqrt(2 / max(freedom, 1))))


def _as_fringes(
    levels: NDArray[np.int64],
    fitted: _Fit,
    counts: Array,
    kept: NDArray[np.bool_],
    which: NDArray[np.int64],
    noise: Noise,
) -> Fringes:
    phase = np.unwrap(fitted.phase)
    basis = _basis(fitted.phase[which], fitted.log_gain)
    usable = np.where(np.isfinite(counts), counts, 0.0)
    pixels, _ = _pixels(usable, basis, 1 / noise.variance(usable.mean(axis=0) * np.ones((len(which), 1))))
    if phase[-1] < 0:  # the cosine is even: both signs fit alike
        phase, pixels = -phase, pixels * np.array([[1.0], [1.0], [-1.0]])
    covariance = fitted.covariance * max(1.0, fitted.chi2)
    return Fringes(
        levels, phase, covariance, np.exp(fitted.log_gain), pixels, kept, fitted.chi2, bool(np.isfinite(phase).all())
    )


def photon_transfer(repeats: Array) -> Noise:
    """Return the noise from frames (m >= 2, n) of one pattern: variance against mean, over the pixels, a straight line.

    The frames are brought to one sum first, so that a drift of the source is no noise.
    """
    total = repeats.sum(axis=1, keepdims=True)
    steady = repeats * (total.mean() / total)
    mean, variance = steady.mean(axis=0), steady.var(axis=0, ddof=1)
    line = np.stack([np.ones_like(mean), np.maximum(mean, 0.0)], axis=1)
    good = np.ones(len(mean), bool)
    read, slope = float(np.median(variance)), 0.0
    for _ in range(8):
        expected = np.maximum(read + slope * np.maximum(mean, 0.0), 1e-3 * float(np.median(variance)) + 1e-9)
        good = variance < 20 * expected  # a pixel that blinks
        weight = 1 / expected[good]
        solved, *_ = np.linalg.lstsq(line[good] * weight[:, None], variance[good] * weight, rcond=None)
        read, slope = (max(float(value), 0.0) for value in solved)
        if solved[0] < 0:
            slope = float(np.sum(weight**2 * line[good, 1] * variance[good]) / np.sum((weight * line[good, 1]) ** 2))
        if solved[1] < 0:
            read = float(np.sum(weight**2 * variance[good]) / np.sum(weight**2))
    return Noise(max(read, 1e-6), slope)


def drift_of(sums: Array, times: Array, noise_var: float) -> Drift:
    """Return how the source drifts, from the summed counts of one pattern taken again and again.

    Parameters
    ----------
    sums, times
        (m,) summed counts, and when they were taken, in frames.
    noise_var
        The relative variance that the sensor's noise gives one sum.
    """
    if len(sums) < 2:
        return Drift(1e-5, 1e-5)
    changes, gaps = np.diff(np.log(sums)), np.diff(times)
    # Repeats that far apart cannot tell a walk from flicker: half of what is seen is laid to each.
    seen = max(float(np.mean(changes**2)) - 2 * noise_var, 0.0)
    return Drift(max(0.5 * seen / float(np.mean(gaps)), 1e-8), max(0.25 * seen, 1e-7))
