"""Phases of unknown steps from the fringes of camera pixels, against steps that the test knows."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import generator

from holocal.estimate.fringes import UNKNOWN_RAD, Drift, Fringes, Noise, drift_of, fit_fringes, photon_transfer

LEVEL = np.arange(256) / 255
TABLES = {
    "short and bent": 0.88 * 2 * np.pi * (LEVEL + 0.07 * np.sin(2 * np.pi * LEVEL)),
    "one and a half turns": 1.5 * 2 * np.pi * LEVEL**1.4,
    "six tenths of a turn": 0.6 * 2 * np.pi * LEVEL**1.5,
    "flat start": 0.95 * 2 * np.pi * np.clip((LEVEL - 0.15) / 0.85, 0, 1) ** 1.5,
}
PER_COUNT = 0.41  # counts per electron: 12 bits over 10,000
READ = 2.5  # counts, rms
GRAINS = 6  # speckle grains per pixel


def sequence(seed, levels=35, every=7):
    """Levels in random order, level 0 before every seventh and at the end."""
    order = generator(seed, 1).permutation(np.linspace(0, 255, levels + 1).round().astype(int)[1:])
    shown = [level for i, one in enumerate(order) for level in ((0, one) if i % every == 0 else (one,))]
    return np.array([*shown, 0])


def frames(table, shown, *, seed, pixels=3000, electrons=1500.0, gains=1.0, noisy=True):
    """Counts (frames, pixels) of speckle a + b exp(i D) integrated over the pixel."""
    rng = generator(seed)
    a, b = _speckle(rng, pixels), _speckle(rng, pixels)
    steady, fringe = (abs(a) ** 2 + abs(b) ** 2).mean(axis=0), 2 * (np.conj(a) * b).mean(axis=0)
    phase = table[shown][:, None]
    light = steady + fringe.real * np.cos(phase) - fringe.imag * np.sin(phase)
    mean = light * electrons / steady.mean() * np.broadcast_to(gains, len(shown))[:, None]
    if not noisy:
        return mean * PER_COUNT
    return np.rint(rng.poisson(mean) * PER_COUNT + READ * rng.normal(size=mean.shape))


def _speckle(rng, pixels):
    return rng.normal(size=(GRAINS, pixels)) + 1j * rng.normal(size=(GRAINS, pixels))


def fitted(counts, shown) -> Fringes:
    """Fit as the procedure does: noise and drift from the repeats of level 0."""
    repeats = np.flatnonzero(shown == 0)
    noise, sums = photon_transfer(counts[repeats]), counts[repeats].sum(axis=1)
    scatter = float(noise.variance(counts[repeats].mean(axis=0)).sum() / sums.mean() ** 2)
    return fit_fringes(counts, shown, noise=noise, drift=drift_of(sums, repeats.astype(float), scatter))


def errors(found, table):
    return found.phase_rad - (table[found.levels] - table[0])


@pytest.mark.parametrize("name", TABLES)
def test_phases_of_unknown_steps_are_found(name):
    table, shown = TABLES[name], sequence(0)
    found = fitted(frames(table, shown, seed=1), shown)
    assert found.valid
    # 3000 pixels of 1500 electrons, half of them modulated: 1.4 / (39 x 0.5 x 55) = 0.0013 rad, against level 0, and
    # about twice that where the phases fill 0.6 of the circle only; four times this
    assert np.abs(errors(found, table)).max() < (0.012 if table[-1] < 4 else 0.006)


def test_without_noise_the_phases_are_exact():
    table, shown = TABLES["short and bent"], sequence(0)
    found = fit_fringes(frames(table, shown, seed=1, noisy=False), shown, noise=Noise(1.0, 0.4), drift=Drift())
    np.testing.assert_allclose(found.phase_rad, table[found.levels] - table[0], atol=1e-5)  # the last step's size


@pytest.mark.parametrize(
    ("pixels", "flicker", "drift"),
    [(1500, 0.0, 0.0), (1500, 0.01, 0.05), (60, 0.0, 0.0)],
    ids=["quiet", "drift", "few"],
)
def test_the_errors_given_are_the_errors_made(pixels, flicker, drift):
    table, seeds = TABLES["short and bent"], range(12)
    per_phase = []
    for seed in seeds:
        shown = sequence(seed)
        rng = generator(seed, 2)
        gains = np.exp(drift * np.sin(np.arange(len(shown)) / 8) + flicker * rng.normal(size=len(shown)))
        found = fitted(frames(table, shown, seed=seed, pixels=pixels, gains=gains), shown)
        e = errors(found, table)[1:]
        per_phase.append(e @ np.linalg.solve(found.covariance[1:, 1:], e) / len(e))
    # 12 x 35 squared errors over their variances scatter by sqrt(2 / 420) = 7 %. Flicker and drift are known from six
    # repeats only, and put into two numbers: their share is right within a factor of two.
    assert 0.7 < np.mean(per_phase) < (1.3 if not drift else 2.0)


def test_a_drift_of_the_source_is_told_from_the_phase_by_the_levels_disorder():
    table, shown = TABLES["short and bent"], sequence(3)
    gains = np.exp(0.2 * np.linspace(-1, 1, len(shown)) ** 2)
    counts = frames(table, shown, seed=3, gains=gains)
    with_drift = fitted(counts, shown)
    assert np.sqrt(np.mean(errors(with_drift, table) ** 2)) < 0.01
    np.testing.assert_allclose(with_drift.gains / gains, np.mean(with_drift.gains / gains), rtol=0.01)
    in_order = np.argsort(shown, kind="stable")  # the same drift, hidden in the order of the levels
    ordered = frames(table, shown[in_order], seed=3, gains=gains)
    assert np.sqrt(np.mean(errors(fitted(ordered, shown[in_order]), table) ** 2)) > 0.02


def test_hot_and_blinking_pixels_are_left_out_and_named():
    table, shown = TABLES["short and bent"], sequence(4)
    counts = frames(table, shown, seed=4)
    rng = generator(5)
    counts[:, :10] += rng.uniform(0, 800, (len(shown), 10))  # a hot pixel's own noise
    counts[7, 10:15] = 4000  # a cosmic ray in one frame
    found = fitted(counts, shown)
    assert not found.kept[:15].any()
    assert found.kept[15:].mean() > 0.99
    assert np.abs(errors(found, table)).max() < 0.006
    assert 0.9 < found.chi2 < 1.1


def test_a_falling_phase_is_given_as_rising():
    table, shown = -TABLES["short and bent"], sequence(6)
    found = fitted(frames(table, shown, seed=6), shown)
    np.testing.assert_allclose(found.phase_rad, -(table[found.levels] - table[0]), atol=0.006)


def test_the_pixels_fringes_are_those_of_the_light():
    table, shown = TABLES["short and bent"], sequence(7)
    found = fitted(frames(table, shown, seed=7, pixels=400), shown)
    clean = frames(table, np.array([0, 128, 255]), seed=7, pixels=400, noisy=False)
    phase = table[[0, 128, 255]]
    basis = np.stack([np.ones(3), np.cos(phase), np.sin(phase)], axis=1)
    # 400 x 3 values of 600 counts with 16 counts of noise per frame, fitted to 41 frames: 2.5 to 5 counts
    np.testing.assert_allclose(basis @ found.pixels, clean, atol=30)


def nothing_found(found):
    assert not found.valid
    assert found.reason
    assert np.all(found.sigma_rad == UNKNOWN_RAD)
    assert np.all(np.isfinite(found.phase_rad))


QUIET = {"noise": Noise(6.0, 0.41), "drift": Drift()}


def test_light_without_a_fringe_gives_no_phases():
    shown = sequence(0)
    flat = generator(0).poisson(600.0, (len(shown), 500)).astype(float)
    nothing_found(fit_fringes(flat, shown, **QUIET))


def test_a_panel_that_does_nothing_gives_no_phases():
    shown = sequence(0)
    nothing_found(fitted(frames(np.zeros(256), shown, seed=0), shown))


def test_a_phase_of_two_values_only_gives_no_circle():
    shown = sequence(0)
    found = fitted(frames(np.where(np.arange(256) > 100, np.pi / 2, 0.0), shown, seed=0), shown)
    nothing_found(found)


@pytest.mark.parametrize(
    ("counts", "shown"),
    [
        (np.zeros((12, 100)), np.arange(12)),
        (np.full((12, 100), np.nan), np.arange(12)),
        (np.ones((12, 3)), np.arange(12)),
        (np.ones((12, 0)), np.arange(12)),
        (np.ones((12, 100)), np.arange(12) % 5),
        (-np.ones((12, 100)), np.arange(12)),
    ],
    ids=["dark", "not numbers", "three pixels", "no pixel", "five levels", "below the dark level"],
)
def test_too_little_to_go_by_is_said_and_not_guessed(counts, shown):
    nothing_found(fit_fringes(counts, shown, **QUIET))


def test_twenty_pixels_are_enough():
    table, shown = TABLES["short and bent"], sequence(8)
    found = fitted(frames(table, shown, seed=8, pixels=20), shown)
    assert np.abs(errors(found, table)[1:] / found.sigma_rad[1:]).max() < 4.5  # 35 errors, and a noise from 20 pixels


@pytest.mark.parametrize(("read", "slope_error"), [(0.0, 0.05), (2.5, 0.05), (25.0, 0.25)])
def test_the_noise_is_read_from_repeats(read, slope_error):
    rng = generator(9)
    mean = rng.gamma(2.0, 400.0, 5000)
    gains = np.array([1.0, 0.97, 1.04, 1.01, 0.95, 1.02])[:, None]
    repeats = rng.poisson(mean * gains) * PER_COUNT + read * rng.normal(size=(6, 5000))
    found = photon_transfer(repeats)
    # a pixel's variance is known to sqrt(2 / 5) of itself; over 5000 pixels whose light differs by 230 counts the slope
    # is known to 1 %, and to 7 % under a read noise of four times the shot noise
    assert found.per_count == pytest.approx(PER_COUNT, rel=slope_error)
    assert found.read_var == pytest.approx(read**2, rel=0.1, abs=6.0)  # what is left at no light: 1 % of 134 + read^2


def test_frames_that_follow_no_fringe_at_all_end_without_an_error_or_are_owned_up_to():
    """A panel whose pixels blur each other shows several phases at once: the frames leave the cone."""
    table, shown = TABLES["short and bent"], sequence(0)
    for seed in range(4):
        rng = generator(seed)
        a, b, c = (_speckle(rng, 400) for _ in range(3))
        phase = table[shown][:, None, None]
        light = np.mean(abs(a + b * np.exp(1j * phase) + c * np.exp(0.4j * phase)) ** 2, axis=1)
        found = fitted(np.rint(rng.poisson(200 * light) * PER_COUNT), shown)
        assert np.all(np.isfinite(found.phase_rad)) and np.all(np.isfinite(found.covariance))
        # 400 pixels x 38 degrees of freedom know chi2 to 1 %; the covariance is larger by it
        assert not found.valid or found.chi2 > 1.5
