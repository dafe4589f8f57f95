"""The procedure `alignment`, whole, through the runner, on the simulated bench with a small panel."""

from __future__ import annotations

import numpy as np
import pytest

from holocal.app.corrections import corrections_of
from holocal.estimate.bench_pose import DISPLACEMENTS, bench_at, spun
from holocal.loop.record import RunRecord
from holocal.loop.runner import run
from holocal.optics.bench import Bench
from holocal.records.calibration import Accepted
from holocal.records.maps import read_maps
from holocal.records.rig import load_rig
from procedures.alignment import Alignment, Parameters
from rigs.simulated.rig import SimulatedRig


class Watcher:
    """Listens to nothing."""

    def preflight(self, checks, seconds): ...

    def waiting(self, what): ...

    def incident(self, sentence): ...

    def step(self, number, progress, judgement): ...


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    rig = SimulatedRig(load_rig("simulated-small", {}))
    record = RunRecord.create(tmp_path_factory.mktemp("runs"), "alignment", config="", identity={})
    with record.open():
        done = run(Alignment(), rig, Parameters(), seed=2, record=record, calibration={}, observer=Watcher())
    return done.result, done.directory


def test_the_bench_that_is_found_predicts_places_and_wavefronts_of_another_colour(found):
    result, _ = found
    assert result["targets_met"] and result["frames"] <= 8
    assert result["verified_nm"] == 639.0
    assert result["before"]["position_rms_px"] > 20 and result["after"]["position_rms_px"] < 0.1
    truth = result["truth"]
    assert truth["predicted_residual_rms_rad"] < 0.05 and truth["predicted_residual_worst_rad"] < 0.15
    assert truth["predicted_residual_rms_rad"] < 0.2 * result["before"]["predicted_residual_rms_rad"]
    assert truth["position_rms_px"] < 0.1


def test_every_displacement_has_a_mean_and_a_sigma_and_its_truth_is_within_reach(found):
    result, _ = found
    for name in DISPLACEMENTS:
        mean, sigma = result["after"][name]["mean"], result["after"][name]["sigma"]
        assert 0 < sigma < 1.0
        assert abs(mean - result["truth"][name]) < 6 * sigma, name


def test_the_mirrors_turn_about_its_own_axis_is_said_to_be_unknown(found):
    (unknown,) = found[0]["undetermined"]
    step = np.diff(spun(Bench.nominal(), np.zeros(12), np.array([-1e-3, 1e-3])), axis=0)[0]
    step /= np.linalg.norm(step)
    said = np.array([unknown.get(name, 0.0) for name in DISPLACEMENTS])
    assert abs(said @ step) / np.linalg.norm(said) > 0.99


def test_the_moves_are_few_and_bring_the_bench_within_tolerance(found):
    moves = found[0]["moves"]
    assert 1 <= len(moves["moves"]) <= 3 and moves["within_tolerance"]
    assert moves["leaves_px"] <= 1.1 * moves["tolerance_px"]
    assert set(moves["moves"]) <= set(DISPLACEMENTS)


def test_what_is_accepted_is_the_bench(found):
    result, directory = found
    maps = read_maps(directory / "maps.exr")
    for name in DISPLACEMENTS:
        assert float(maps.metadata[f"bench.{name}"]) == pytest.approx(result["after"][name]["mean"], abs=1e-6)
    accepted = {
        name: Accepted(name, "entry", "2026-01-01T00:00:00Z", result, maps) for name in ("alignment", "aberration")
    }
    corrections = corrections_of(accepted, fov_rad=(0.4, 0.4))
    values = np.array([result["after"][name]["mean"] for name in DISPLACEMENTS])
    np.testing.assert_allclose(
        corrections.bench(Bench.nominal()).slm_centre, bench_at(Bench.nominal(), values).slm_centre, atol=1e-8
    )
    assert corrections.wavefront is None
    assert corrections.skipped(515.0) == ["the accepted aberration: the accepted bench (alignment) explains it"]


def test_a_mirror_turned_about_its_own_axis_is_the_same_surface():
    values = np.array([0.2, -0.3, 0.1, 0.2, -0.1, 0.3, 0.1, 0.2, -0.1, 0.1, 0.2, 0.3])
    plain = bench_at(Bench.nominal(), values)
    for turned in spun(Bench.nominal(), values, np.array([-0.03, 0.01, 0.05])):
        assert np.abs(turned[:6] - values[:6]).max() > 0.1
        bench = bench_at(Bench.nominal(), turned)
        np.testing.assert_allclose(bench.mirror_quadric, plain.mirror_quadric, rtol=0, atol=1e-9)
        np.testing.assert_allclose(bench.mirror_centre, plain.mirror_centre, atol=1e-15)
