"""Waves of spots over the whole panel: against the exact sum, and against their own adjoint."""

import numpy as np
import pytest
import torch

from holocal.errors import SamplingError
from holocal.optics.bench import Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.spots import analyse, derivative, spot_waves, synthesise

WAVELENGTH_M = 515e-9
BENCH = Bench.nominal()
TANGENTS = np.array([[0.0, 0.0], [0.09, -0.05], [-0.13, 0.11], [0.02, 0.17]])
PANELS = {"whole blocks": Panel(480, 272, 3.74e-6), "cut blocks": Panel(351, 277, 5.2e-6)}


def soft(pupil_m):
    """A smooth window, asymmetric, 0 beyond 2.6 mm."""
    r = np.linalg.norm(pupil_m - np.array([0.2e-3, -0.1e-3]), axis=-1)
    return np.where(r < 2.3e-3, np.cos(np.pi / 2 * np.minimum(r / 2.3e-3, 1.0)) ** 2, 0.0)


def waves_of(panel, tangents=TANGENTS):
    return spot_waves(BENCH, panel, VirtualPoints.at(tangents), wavelength_m=WAVELENGTH_M)


def random_amplitude(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, 2, count) * np.exp(1j * rng.uniform(0, 2 * np.pi, count))


@pytest.mark.parametrize("name", PANELS)
def test_the_sum_of_waves_is_the_exact_sum_over_points(name):
    panel = PANELS[name]
    amplitude = random_amplitude(len(TANGENTS))
    found = synthesise(waves_of(panel), amplitude, soft, reach_m=2.6e-3).numpy()
    assert found.shape == (panel.height, panel.width)
    rng = np.random.default_rng(1)
    row, column = rng.integers(0, panel.height, 400), rng.integers(0, panel.width, 400)
    slm = np.stack([panel.x_m[column], panel.y_m[row]], axis=-1)
    exact = exact_phase(BENCH, VirtualPoints.at(TANGENTS), slm[:, None], wavelength_m=WAVELENGTH_M)
    wanted = np.sum(amplitude * soft(exact.pupil_m) * np.exp(1j * exact.phase_rad), axis=1)
    error = np.linalg.norm(found[row, column] - wanted) / np.linalg.norm(wanted)
    assert error < 4e-3  # the window is taken once per block: a few thousandths of its slope; the phase leaves 0.002


@pytest.mark.parametrize("name", PANELS)
def test_analysis_is_the_adjoint_of_synthesis(name):
    panel = PANELS[name]
    waves, amplitude = waves_of(panel), random_amplitude(len(TANGENTS), 2)
    reach = 1.0  # everything
    rng = np.random.default_rng(3)
    field = torch.from_numpy(
        (rng.normal(size=(panel.height, panel.width)) + 1j * rng.normal(size=(panel.height, panel.width))).astype(
            np.complex64
        )
    )
    sent = synthesise(waves, amplitude, lambda q: np.ones(q.shape[:-1]), reach_m=reach)
    one = complex(torch.sum(field.conj().to(torch.complex128) * sent.to(torch.complex128)))
    held = np.array([np.sum(values.astype(complex)) for _, values in analyse(waves, field, reach_m=reach)])
    other = np.vdot(held, amplitude)
    assert abs(one - other) < 1e-4 * np.linalg.norm(held) * np.linalg.norm(amplitude)  # float32 sums of 1e5 pixels


def test_a_spot_is_held_by_its_own_wave_and_hardly_by_another():
    panel = PANELS["whole blocks"]
    waves = waves_of(panel)
    alone = synthesise(waves, np.array([1.0, 0, 0, 0]), lambda q: np.ones(q.shape[:-1]), reach_m=2.0e-3)
    held = [np.abs(np.sum(values)) for _, values in analyse(waves, alone, reach_m=1.5e-3)]
    assert held[0] > 20 * max(held[1:])


def test_light_from_a_quarter_of_an_order_away_is_not_taken_for_the_points_own():
    panel = PANELS["whole blocks"]
    waves = waves_of(panel)
    alone = synthesise(waves, np.array([1.0, 0, 0, 0]), lambda q: np.ones(q.shape[:-1]), reach_m=2.0e-3)

    def light_inside(field):  # at the panel's edges a corner has half its weights
        pupil, values = analyse(waves, field, reach_m=1.5e-3)[0]
        off = np.abs(pupil - pupil.mean(axis=0))
        return np.sum(np.abs(values[np.all(off < 0.8 * off.max(axis=0), axis=1)]) ** 2)

    for turns in (0.25 - 0.01, 0.25 + 0.01):  # per pixel: blocks of 4 see it as 0.01 turns per pixel
        ramp = torch.polar(torch.ones(panel.width), 2 * np.pi * turns * torch.arange(panel.width))
        assert light_inside(alone * ramp) < 1e-5 * light_inside(alone)  # evenly weighted blocks: 1.5e-3


def test_blocks_beyond_reach_are_left_out_and_their_pupil_points_are_exact():
    panel = PANELS["whole blocks"]
    waves = waves_of(panel)
    pupil, values = analyse(waves, torch.ones((panel.height, panel.width), dtype=torch.complex64), reach_m=0.4e-3)[0]
    assert len(pupil) == len(values) > 100
    assert np.linalg.norm(pupil, axis=1).max() <= 0.4e-3
    x, y = (line - 2 * panel.pitch_m * sign for line, sign in zip(waves.block_grid(), (1, -1), strict=True))
    slm = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    exact = exact_phase(BENCH, VirtualPoints.at(TANGENTS[0]), slm, wavelength_m=WAVELENGTH_M).pupil_m
    distance = np.linalg.norm(exact[:, None] - pupil[None, :20], axis=-1).min(axis=0)
    assert distance.max() < 1e-9


def test_an_added_phase_is_added():
    panel, k = PANELS["whole blocks"], 2 * np.pi / WAVELENGTH_M
    waves = waves_of(panel)

    def defocus(pupil_m):
        return 0.5 * k * 3.0 * np.sum(pupil_m**2, axis=-1)

    slm = np.random.default_rng(4).uniform(-0.4e-3, 0.4e-3, (50, 2))
    added = waves.with_phase(defocus).turns.at(slm) - waves.turns.at(slm)
    assert np.allclose(2 * np.pi * added, defocus(waves.pupil.at(slm)), atol=1e-3)


def test_a_phase_that_is_not_smooth_is_refused():
    waves = waves_of(PANELS["whole blocks"])
    with pytest.raises(SamplingError, match="not smooth"):
        waves.with_phase(lambda q: 40 * np.sign(q[..., 0]))


def test_the_derivative_of_a_series_is_its_difference_quotient():
    series = waves_of(PANELS["whole blocks"]).turns
    at, step = np.array([[2e-4, -1e-4], [-5e-4, 3e-4]]), 1e-7
    for axis, unit in ((0, np.array([0, 1.0])), (1, np.array([1.0, 0]))):
        quotient = (series.at(at + step * unit) - series.at(at - step * unit)) / (2 * step)
        assert np.allclose(derivative(series, axis).at(at), quotient, rtol=1e-6, atol=1e-3)
