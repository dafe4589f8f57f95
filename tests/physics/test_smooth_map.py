"""The smooth map of the plane: held-out error, Jacobian, uncertainty, extrapolation and inverse."""

from __future__ import annotations

import numpy as np
import pytest

from holocal.errors import UsageError
from holocal.estimate.map_basis import SplineBasis, apply_homography, chebyshev, chebyshev_slopes, fit_homography
from holocal.estimate.map_fit import fit_smooth_map, local_residual_px

NOISE_PX = 0.02


def lattice(columns: int = 40, rows: int = 30) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)


def lens(points: np.ndarray, *, k1: float = -0.2, k2: float = 0.05, tilt: float = 0.1) -> np.ndarray:
    """A tilted, turned target through a lens: points about (20, 15), 25 px apart, distorted about the picture."""
    at = (points - [20, 15]) @ np.array([[0.98, 0.17], [-0.17, 0.98]]) / 20
    at = at / (1 + tilt * at[:, :1] + 0.05 * at[:, 1:])
    r2 = (at**2).sum(axis=1, keepdims=True)
    return 500 * at * (1 + k1 * r2 + k2 * r2**2) + [640, 480]


@pytest.fixture(scope="module")
def noisy():
    points = lattice()
    rng = np.random.default_rng(3)
    return points, fit_smooth_map(points, lens(points) + NOISE_PX * rng.normal(size=points.shape))


def test_the_held_out_error_is_the_noise(noisy):
    _, found = noisy
    # Root two for two coordinates; 1.02 for the fit's own share of the error.
    assert found.holdout_rms_px == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.06)
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.06)
    assert 3 <= found.degree <= 8


def test_the_map_is_better_than_the_dots_and_says_by_how_much(noisy):
    points, found = noisy
    error = found(points) - lens(points)
    assert np.sqrt(np.mean(error**2)) < 0.4 * NOISE_PX
    z = error / found.sigma_px(points)[:, None]
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.6  # some 20 coefficients: their errors are few numbers


def test_the_jacobian_is_the_derivative(noisy):
    points, found = noisy
    inner = points[(points > 1).all(axis=1) & (points < [38, 28]).all(axis=1)] + 0.3
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = 1e-4
        slope = (found(inner + step) - found(inner - step)) / 2e-4
        assert np.abs(slope - found.jacobian(inner)[:, :, axis]).max() < 1e-5


def test_the_inverse_finds_places_to_a_hundredth_of_a_pixel(noisy):
    _, found = noisy
    rng = np.random.default_rng(0)
    within = rng.uniform(0, [39, 29], (2000, 2))
    beyond = rng.uniform(-4, [43, 33], (500, 2))
    for asked in (within, beyond):
        back, ok = found.inverse(found(asked))
        assert ok.all()
        assert np.linalg.norm(found(back) - found(asked), axis=1).max() < 0.01
    back, _ = found.inverse(found(within))
    assert np.abs(back - within).max() < 1e-3


def test_beyond_the_hull_the_map_goes_on_straight(noisy):
    _, found = noisy
    out = np.array([[-1.0, 15], [-3, 15], [-6, 15]])
    places = found(out)
    assert np.allclose((places[1] - places[0]) / 2, (places[2] - places[1]) / 3, atol=1e-9)
    assert np.allclose(found.jacobian(out)[0], found.jacobian(out)[2])
    edge = found(np.array([[0.0, 15.0]]))[0]
    assert np.linalg.norm(found(np.array([[-1e-6, 15.0]]))[0] - edge) < 1e-3  # continuous
    # Two spacings out the true lens is followed to a twentieth of a spacing: what its bend is worth there.
    assert np.linalg.norm(found(np.array([[-2.0, 15.0]])) - lens(np.array([[-2.0, 15.0]]))) < 1.5


def test_the_uncertainty_grows_beyond_the_hull_and_covers_the_error(noisy):
    _, found = noisy
    out = np.column_stack([np.array([0.0, -1, -2, -4, -8]), np.full(5, 15.0)])
    sigma = found.sigma_px(out)
    assert (np.diff(sigma) > 0).all()
    error = np.linalg.norm(found(out) - lens(out), axis=1)
    assert (error < 4 * sigma + 0.02).all()


def test_polynomials_do_not_run_away_where_a_quadrant_has_no_dots():
    points = lattice()
    kept = ~((points[:, 0] > 20) & (points[:, 1] > 15))
    rng = np.random.default_rng(5)
    truth = lens(points, k1=-0.08, k2=0.0, tilt=0.05)
    found = fit_smooth_map(points[kept], truth[kept] + NOISE_PX * rng.normal(size=(kept.sum(), 2)))
    error = np.linalg.norm(found(points[~kept]) - truth[~kept], axis=1)
    sigma = found.sigma_px(points[~kept])
    assert error.max() < 40  # the farthest is 14 spacings of 25 px from the nearest dot
    assert np.median(error) < 1
    assert np.quantile(error / sigma, 0.9) < 4
    assert np.median(sigma) > 3 * np.median(found.sigma_px(points[kept]))


def test_outliers_have_no_say_and_are_named():
    points = lattice()
    rng = np.random.default_rng(7)
    places = lens(points) + NOISE_PX * rng.normal(size=points.shape)
    bad = rng.choice(len(points), 60, replace=False)
    places[bad] += rng.uniform(0.5, 4, (60, 2))
    found = fit_smooth_map(points, places)
    assert set(bad) <= set(np.flatnonzero(found.outlier))
    assert np.count_nonzero(found.outlier) < 66
    assert np.sqrt(np.mean((found(points) - lens(points)) ** 2)) < 0.5 * NOISE_PX


def test_what_polynomials_leave_a_spline_takes():
    points = lattice(60, 45)
    waves = 0.3 * np.column_stack([np.sin(points[:, 0] / 3) * np.cos(points[:, 1] / 4), np.sin(points[:, 1] / 3.5)])
    rng = np.random.default_rng(2)
    places = 12 * points + waves + NOISE_PX * rng.normal(size=points.shape)
    found = fit_smooth_map(points, places)
    assert found.spline is not None
    assert found.holdout_rms_px < 1.3 * NOISE_PX * np.sqrt(2)
    inner = points[::7] * 0.9 + 2.2
    step = np.array([1e-4, 0])
    slope = (found(inner + step) - found(inner - step)) / 2e-4
    assert np.abs(slope - found.jacobian(inner)[:, :, 0]).max() < 1e-4


def test_the_surer_points_count_more():
    points = lattice(20, 20)
    rng = np.random.default_rng(4)
    sigma = np.where(rng.random(len(points)) < 0.5, 0.01, 0.2)
    places = 20 * points + sigma[:, None] * rng.normal(size=points.shape)
    weighted = fit_smooth_map(points, places, sigma_px=sigma)(points) - 20 * points
    equal = fit_smooth_map(points, places)(points) - 20 * points
    assert np.sqrt(np.mean(weighted**2)) < 0.5 * np.sqrt(np.mean(equal**2))


def test_the_local_residual_is_the_noise_whatever_the_lens():
    points = lattice()
    rng = np.random.default_rng(9)
    residual = local_residual_px(points, lens(points) + NOISE_PX * rng.normal(size=points.shape))
    residual = residual[((points > 2) & (points < [37, 27])).all(axis=1)]  # neighbours on all sides
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.08)


@pytest.mark.parametrize("count", [6, 9, 12, 20])
def test_few_points_give_a_simple_map(count):
    points = lattice(5, 4)[:count] if count > 5 else lattice(3, 2)
    found = fit_smooth_map(points, 10 * points + 3)
    assert np.abs(found(points) - 10 * points - 3).max() < 1e-3
    assert np.isfinite(found(points + 30)).all()


def test_too_few_points_are_refused():
    with pytest.raises(UsageError, match="5 points"):
        fit_smooth_map(np.zeros((5, 2)), np.zeros((5, 2)))


def test_a_homography_is_found_exactly():
    truth = np.array([[20.0, 3, 100], [-2, 24, 50], [1e-3, 2e-3, 1]])
    points = lattice(8, 6)
    found = fit_homography(points, apply_homography(truth, points)[0], np.ones(len(points)))
    assert np.allclose(found, truth, rtol=1e-6, atol=1e-8)


def test_bases_have_the_derivatives_that_they_say():
    at = np.random.default_rng(0).uniform(-0.95, 0.95, (50, 2))
    splines = SplineBasis((5, 7))
    assert np.allclose(np.asarray(splines.values(at).sum(axis=1)).ravel(), 1)
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = 1e-5
        change = (chebyshev(at + step, 6) - chebyshev(at - step, 6)) / 2e-5
        assert np.allclose(change, chebyshev_slopes(at, 6)[..., axis], atol=1e-6)
        change = (splines.values(at + step) - splines.values(at - step)) / 2e-5
        assert np.allclose(change.toarray(), splines.slopes(at)[axis].toarray(), atol=1e-6)
