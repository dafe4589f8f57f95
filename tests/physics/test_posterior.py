"""What measurements leave possible: samples against closed forms and a grid; refusals; how well intervals cover."""

from __future__ import annotations

import emcee
import numpy as np
import pytest
from scipy.stats import f as f_distribution
from scipy.stats import kstest, multivariate_t
from synthetic import generator

from holocal.errors import InputError
from holocal.estimate import posterior
from holocal.estimate.coverage import ONE_SIGMA, coverage
from holocal.estimate.posterior import LaplaceFit, StudentProposal, autocorrelation_steps, sample_posterior


def gaussian(dimensions, seed=0):
    """A correlated Gaussian whose parameters differ a thousandfold in scale, as (mean, covariance, log-probability)."""
    rng = generator(seed, dimensions)
    mixed = rng.normal(size=(dimensions, dimensions))
    scale = 10 ** rng.uniform(-2, 1, dimensions)
    covariance = (mixed @ mixed.T / dimensions + 0.2 * np.eye(dimensions)) * scale * scale[:, None]
    mean, precision = 3 * scale * rng.normal(size=dimensions), np.linalg.inv(covariance)
    return mean, covariance, lambda x: -0.5 * np.einsum("ni,ij,nj->n", x - mean, precision, x - mean)


def banana(x, bend=0.3):
    """x0 a unit Gaussian, x1 a unit Gaussian round `bend` x0 squared: not Gaussian, not symmetric in x1."""
    return -0.5 * x[:, 0] ** 2 - 0.5 * (x[:, 1] - bend * x[:, 0] ** 2) ** 2


def skewed(x):
    """The log of a gamma-distributed rate with a normal offset that hangs on it: one long tail, in both parameters."""
    return 3 * x[:, 0] - np.exp(x[:, 0]) - 0.5 * (x[:, 1] - x[:, 0]) ** 2


def on_a_grid(log_probability, half_width, count=1201):
    """Mean, covariance and third central moments of two parameters, by summing over a grid: no sampler, no draw."""
    axis = np.linspace(-half_width, half_width, count)
    places = np.stack([a.ravel() for a in np.meshgrid(axis, axis, indexing="ij")], axis=1)
    weight = np.exp(log_probability(places))
    weight /= weight.sum()
    mean = weight @ places
    off = places - mean
    return mean, (off * weight[:, None]).T @ off, weight @ off**3


def check_moments(found, mean, covariance, sigmas=4.5):
    """Means and standard deviations within `sigmas` of their own Monte-Carlo error.

    27 means and 27 standard deviations are some 50 draws of a Gaussian: the largest is above 4.5 in one seed of 3000.
    A standard deviation from n independent Gaussian draws has the relative error 1 / sqrt(2 n).
    """
    sd = np.sqrt(np.diag(covariance))
    assert np.abs((found.mean - mean) / sd).max() < sigmas / np.sqrt(found.effective_samples)
    ratio = np.sqrt(np.diag(found.covariance)) / sd
    assert np.abs(ratio - 1).max() < sigmas / np.sqrt(2 * found.effective_samples)


@pytest.mark.parametrize("dimensions", [1, 5, 27])
def test_a_correlated_gaussian_comes_back_with_a_memory_below_5_steps(dimensions):
    mean, covariance, log_probability = gaussian(dimensions)
    found = sample_posterior(log_probability, LaplaceFit(mean, covariance), seed=3)
    assert found.converged and found.reason == ""
    check_moments(found, mean, covariance)
    sd = np.sqrt(np.diag(covariance))
    correlation = found.covariance / sd / sd[:, None]
    # an entry's error is at most sqrt(2 / n), at the diagonal: 5 of these, as there are 378 entries
    expected = covariance / sd / sd[:, None]
    assert np.abs(correlation - expected).max() < 5 * np.sqrt(2 / found.effective_samples)
    assert found.autocorrelation_steps.max() <= 5  # 1.1, 1.5 and 2.9 measured; notes on emcee: 4 in 33 dimensions
    assert found.effective_samples > 4000
    assert found.calls < 20_000  # what the docstring says of 27 dimensions
    np.testing.assert_allclose(found.sigma_ratio, np.sqrt(np.diag(found.covariance)) / sd)
    assert len(found.samples) > 5000
    assert np.abs((found.samples.mean(axis=0) - mean) / sd).max() < 4.5 / np.sqrt(found.effective_samples / 2)


@pytest.mark.parametrize("times", [0.5, 2.0])
@pytest.mark.parametrize("dimensions", [5, 27])
def test_a_fit_whose_covariance_is_two_times_off_still_gives_the_right_posterior(dimensions, times):
    mean, covariance, log_probability = gaussian(dimensions, 1)
    found = sample_posterior(log_probability, LaplaceFit(mean, times * covariance), seed=4)
    assert found.converged
    check_moments(found, mean, covariance)
    assert found.sigma_ratio == pytest.approx(times**-0.5, rel=0.05)  # 4 % is 4.5 sigma of 6000 effective samples


@pytest.mark.parametrize("log_probability", [banana, skewed], ids=["banana", "skewed"])
@pytest.mark.parametrize("degrees_of_freedom", [4.0, 8.0])
def test_posteriors_that_are_no_gaussian_agree_with_a_sum_over_a_grid(log_probability, degrees_of_freedom):
    mean, covariance, third = on_a_grid(log_probability, 12.0)
    fit = laplace_of(log_probability)
    found = sample_posterior(log_probability, fit, seed=5, degrees_of_freedom=degrees_of_freedom)
    assert found.converged
    sd = np.sqrt(np.diag(covariance))
    # a standard deviation's error is sqrt((kurtosis - 1) / 2) of a Gaussian's: 1.7 times at 7, the largest here
    check_moments(found, mean, covariance, sigmas=8.0)
    skewness = ((found.samples - found.mean) ** 3).mean(axis=0) / sd**3
    assert skewness == pytest.approx(third / sd**3, abs=0.25)  # of 0 to 2.1; its error at 4000 samples is 0.1
    # the Laplace fit itself is far outside these errors: the chain has moved off it
    assert np.abs(fit.mean - mean).max() / sd.max() > 0.1


def laplace_of(log_probability):
    """The curvature at the maximum by differences, as a fit would have it: (0, 0) of the banana, (log 3, log 3)."""
    mean = np.zeros(2) if log_probability is banana else np.full(2, np.log(3))
    step, curvature = 1e-3, np.empty((2, 2))
    for i, j in np.ndindex(2, 2):
        a, b = step * np.eye(2)[i], step * np.eye(2)[j]
        corners = log_probability(mean + np.array([a + b, a - b, b - a, -a - b]))
        curvature[i, j] = -(corners @ [1, -1, -1, 1]) / (4 * step**2)
    return LaplaceFit(mean, np.linalg.inv(curvature))


@pytest.mark.parametrize("wrong", ["left out", "turned round", "of a Gaussian"])
def test_a_wrong_metropolis_hastings_factor_would_be_seen(monkeypatch, wrong):
    call = StudentProposal.__call__

    def mistaken(self, places, random):
        new, factor = call(self, places, random)
        gauss = 0.5 * np.sum(new**2 - places**2, axis=1)
        return new, {"left out": 0 * factor, "turned round": -factor, "of a Gaussian": gauss}[wrong]

    monkeypatch.setattr(StudentProposal, "__call__", mistaken)
    mean, covariance, _ = on_a_grid(banana, 12.0)
    found = sample_posterior(banana, laplace_of(banana), seed=5)
    with pytest.raises(AssertionError):
        check_moments(found, mean, covariance, sigmas=8.0)  # the bar that the right factor passes


def test_a_posterior_that_bends_out_of_the_fit_is_not_taken_for_sampled():
    found = sample_posterior(lambda x: banana(x, bend=3.0), LaplaceFit(np.zeros(2), np.eye(2)), seed=5)
    # at two sigma of x0 the other parameter is 12 sigma off: walkers that get there stay for hundreds of steps
    assert not found.converged and "autocorrelation times" in found.reason


def test_the_proposals_are_drawn_from_the_density_that_the_factor_takes():
    proposal = StudentProposal(3, 8.0)
    draws = proposal.draw(100_000, np.random.RandomState(np.random.MT19937(1)))
    # 8 / 6: the variance of a Student-t with 8 degrees of freedom; its error is sqrt(3.5 / n) of it, here 4 of these
    np.testing.assert_allclose(np.cov(draws, rowvar=False), 8 / 6 * np.eye(3), atol=0.032)
    assert kstest(np.sum(draws**2, axis=1) / 3, f_distribution(3, 8).cdf).pvalue > 1e-3  # one seed of a thousand
    exact = multivariate_t(np.zeros(3), np.eye(3), df=8).logpdf(draws[:100])
    mine = proposal.log_density(draws[:100])
    np.testing.assert_allclose(mine - mine[0], exact - exact[0], atol=1e-10)  # rounding of numbers of about 30


def test_nuisances_are_sampled_but_only_what_is_asked_for_is_reported():
    mean, covariance, log_probability = gaussian(6)
    asked = np.array([True, False, True, True, False, False])
    every = sample_posterior(log_probability, LaplaceFit(mean, covariance), seed=6)
    found = sample_posterior(log_probability, LaplaceFit(mean, covariance), seed=6, reported=asked)
    np.testing.assert_array_equal(found.samples, every.samples[:, asked])
    np.testing.assert_array_equal(found.mean, every.mean[asked])
    np.testing.assert_allclose(found.covariance, every.covariance[np.ix_(asked, asked)])
    assert found.autocorrelation_steps.shape == found.sigma_ratio.shape == (3,)
    check_moments(found, mean[asked], covariance[np.ix_(asked, asked)])  # marginal: not what holding the others gives
    held = np.sqrt(1 / np.diag(np.linalg.inv(covariance)))[asked]
    assert np.all(np.sqrt(np.diag(found.covariance)) > 1.1 * held)


def test_the_same_seed_gives_the_same_samples_and_numpys_own_state_is_left_alone():
    mean, covariance, log_probability = gaussian(3)
    fit = LaplaceFit(mean, covariance)
    np.random.seed(1)  # noqa: NPY002 - the state that must not matter
    before = np.random.get_state()  # noqa: NPY002
    first = sample_posterior(log_probability, fit, seed=7)
    for one, other in zip(before, np.random.get_state(), strict=True):  # noqa: NPY002
        np.testing.assert_array_equal(one, other)
    np.random.seed(2)  # noqa: NPY002
    np.testing.assert_array_equal(sample_posterior(log_probability, fit, seed=7).samples, first.samples)
    assert not np.array_equal(sample_posterior(log_probability, fit, seed=8).samples, first.samples)


def test_numpys_own_state_is_not_even_read(monkeypatch):
    def read(*_):
        raise AssertionError("the global state was read")

    monkeypatch.setattr(np.random, "get_state", read)
    mean, covariance, log_probability = gaussian(2)
    assert sample_posterior(log_probability, LaplaceFit(mean, covariance), seed=1).converged


def test_arguments_are_read_and_not_written():
    mean, covariance, log_probability = gaussian(3)
    fit = LaplaceFit(mean.copy(), covariance.copy())
    sample_posterior(log_probability, fit, seed=1)
    np.testing.assert_array_equal(fit.mean, mean)
    np.testing.assert_array_equal(fit.covariance, covariance)


def refused(found, *words):
    """Nothing was sampled, and the reason holds the words."""
    assert not found.converged
    assert found.samples.shape == (0, found.mean.size)
    assert found.effective_samples == 0 and np.all(np.isinf(found.autocorrelation_steps))
    assert found.reason.endswith(".") and all(word in found.reason for word in words), found.reason
    return True


def test_more_dimensions_than_48_are_refused_with_the_number():
    mean, covariance, log_probability = gaussian(49)
    found = sample_posterior(log_probability, LaplaceFit(mean, covariance), seed=1)
    assert refused(found, "49 dimensions", "at most 48", "98") and found.calls == 0
    assert posterior.MOST_DIMENSIONS == 48


@pytest.mark.parametrize(
    ("covariance", "words"),
    [
        (np.diag([1.0, -1.0]), "not positive definite"),
        (np.diag([1.0, 0.0]), "not positive definite"),
        (np.array([[1.0, 1.0], [1.0, 1.0]]), "a direction is not determined"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "least eigenvalue of the correlations -1.0e+00"),
        (np.array([[np.nan, 0.0], [0.0, 1.0]]), "not finite"),
        (np.array([[np.inf, 0.0], [0.0, 1.0]]), "not finite"),
    ],
)
def test_a_covariance_that_is_none_is_refused(covariance, words):
    assert refused(sample_posterior(banana, LaplaceFit(np.zeros(2), covariance), seed=1), words)


@pytest.mark.parametrize("value", [np.nan, -np.inf, np.inf])
def test_a_log_probability_that_is_not_finite_at_the_mean_is_refused(value):
    found = sample_posterior(lambda x: np.full(len(x), value), LaplaceFit(np.zeros(2), np.eye(2)), seed=1)
    assert refused(found, f"mean is {value}") and found.calls == 1


def test_a_fit_at_a_sharp_edge_is_refused_rather_than_sampled_from_nothing():
    def spike(x):
        return np.where(np.abs(x).max(axis=1) < 1e-3, 0.0, -np.inf)

    found = sample_posterior(spike, LaplaceFit(np.zeros(3), np.eye(3)), seed=1)
    assert refused(found, "% of places drawn", "edge")


def test_an_edge_within_the_posterior_is_sampled_right():
    found = sample_posterior(
        lambda x: np.where(x[:, 0] > 0, -0.5 * np.sum(x**2, axis=1), -np.inf),
        LaplaceFit(np.array([0.01, 0.0]), np.eye(2)),
        seed=2,
    )
    assert found.converged
    # a half Gaussian: mean sqrt(2 / pi), variance 1 - 2 / pi; 4.5 sigma
    check_moments(found, [np.sqrt(2 / np.pi), 0.0], np.diag([1 - 2 / np.pi, 1.0]))


def test_a_fit_far_from_the_posterior_is_said_to_be():
    mean, covariance, log_probability = gaussian(5)
    off = LaplaceFit(mean + 8 * np.sqrt(np.diag(covariance)), covariance)
    found = sample_posterior(log_probability, off, seed=1)
    assert not found.converged
    assert "of proposals were taken" in found.reason and "far from the posterior" in found.reason
    assert found.calls < 30_000  # stopped at the first look, not at the longest chain


def test_a_chain_that_is_too_short_gives_its_samples_but_no_trust():
    mean, covariance, log_probability = gaussian(5)
    found = sample_posterior(log_probability, LaplaceFit(mean, covariance), seed=1, longest=50)
    assert not found.converged and len(found.samples) > 0
    assert found.reason.startswith("The chain of 45 steps holds") and "50 are needed" in found.reason
    assert found.calls == 1 + 51 * posterior.LEAST_WALKERS


def test_a_log_probability_that_is_no_number_somewhere_is_owned_up_to():
    def holed(x):
        return np.where(x[:, 0] > 1.5, np.nan, -0.5 * np.sum(x**2, axis=1))

    found = sample_posterior(holed, LaplaceFit(np.zeros(2), np.eye(2)), seed=1)
    assert not found.converged and "was not a number at" in found.reason
    assert np.all(np.isfinite(found.samples))


@pytest.mark.parametrize("wrong", [lambda x: 0.0, lambda x: np.zeros((len(x), 1)), lambda x: np.zeros(3)])
def test_a_log_probability_of_the_wrong_shape_is_an_error(wrong):
    with pytest.raises(InputError, match="shape"):
        sample_posterior(wrong, LaplaceFit(np.zeros(2), np.eye(2)), seed=1)


@pytest.mark.parametrize(
    "arguments",
    [
        {"fit": LaplaceFit(np.zeros(3), np.eye(2))},
        {"reported": [True]},
        {"reported": [False, False]},
        {"longest": 0},
        {"degrees_of_freedom": 0.0},
    ],
)
def test_arguments_that_do_not_fit_together_are_an_error(arguments):
    with pytest.raises(InputError):
        sample_posterior(banana, **{"fit": LaplaceFit(np.zeros(2), np.eye(2)), "seed": 1, **arguments})


def test_the_autocorrelation_time_is_that_of_a_process_that_is_known():
    for memory in (0.0, 0.5, 0.8):
        noise = generator(2).normal(size=(3000, 40, 1))
        chain = np.zeros_like(noise)
        for step in range(1, len(noise)):
            chain[step] = memory * chain[step - 1] + np.sqrt(1 - memory**2) * noise[step]
        found = autocorrelation_steps(chain[200:])[0]
        # an AR(1) process: (1 + a) / (1 - a); 112,000 steps give it to 2 %, the window cuts e^-5 off
        assert found == pytest.approx((1 + memory) / (1 - memory), rel=0.06)
        # emcee's takes each walker's own mean out: lower by 10 times / steps, 3 % at a time of 9 steps
        assert found == pytest.approx(emcee.autocorr.integrated_time(chain[200:], tol=0)[0], rel=0.06)


def test_walkers_that_never_move_have_a_long_memory_and_one_place_an_endless_one():
    stuck = np.repeat(generator(3).normal(size=(1, 8, 1)), 100, axis=0)
    assert autocorrelation_steps(stuck)[0] > 50
    assert np.isinf(autocorrelation_steps(np.ones((100, 8, 1)))[0])


def test_coverage_of_a_known_case():
    found = coverage([0.5, -0.5, 2.0, 0.0], [1.0, 1.0, 1.0, 1.0], np.zeros(4))
    assert (found.fraction, found.count) == (0.75, 4)
    assert found.rms_z == pytest.approx(np.sqrt(4.5 / 4))
    assert found.fraction_sigma == pytest.approx(np.sqrt((4 / 6) * (2 / 6) / 6))


@pytest.mark.parametrize("size", [0.5, 1.0, 2.0])
def test_coverage_tells_errors_that_are_as_large_as_said_from_others(size):
    rng = generator(4)
    truth, sigma = rng.normal(size=2000), rng.uniform(0.1, 3.0, 2000)
    found = coverage(truth + size * sigma * rng.normal(size=2000), sigma, truth)
    assert found.rms_z == pytest.approx(size, rel=0.07)  # 1 / sqrt(2 n) is 1.6 %
    assert found.expected == ONE_SIGMA == pytest.approx(0.6827, abs=1e-4)
    assert (abs(found.fraction - found.expected) < 4 * found.fraction_sigma) == (size == 1.0)


def test_coverage_of_all_or_none_has_an_error_and_of_what_is_unknown_is_refused():
    assert coverage([0.0] * 10, [1.0] * 10, [0.0] * 10).fraction_sigma > 0.05
    assert coverage([9.0] * 10, [1.0] * 10, [0.0] * 10).fraction_sigma > 0.05
    for estimates, sigmas in (([], []), ([1.0], [0.0]), ([np.nan], [1.0]), ([1.0], [np.nan])):
        with pytest.raises(InputError, match="Coverage"):
            coverage(estimates, sigmas, np.zeros(len(estimates)))
