"""The procedure `aberration` in mode `search`, whole, through the runner, on the simulated bench with a small panel."""

from __future__ import annotations

import numpy as np
import pytest
from test_aberration import SMALL, Watcher, tables

from holocal.app.corrections import corrections_of
from holocal.errors import Interrupted, RefusedError
from holocal.loop.checkpoint import state_bytes, state_from_bytes
from holocal.loop.procedure import Outcome
from holocal.loop.record import RunRecord, read_journal
from holocal.loop.runner import run
from holocal.optics.bench import Panel
from holocal.records.calibration import Accepted
from holocal.records.maps import read_maps
from procedures._aberration_light import array_of
from procedures._aberration_windows import gradient_to_place, ideal_concentration, lit_pupils
from procedures.aberration import Aberration, Parameters
from rigs.simulated.rig import SimulatedRig

CHOSEN = {"mode": "search", "zones": 3, "search_passes": 2}
OUT = {"misalignment__slm_shift_mm": [0.2, -0.1, 1.0]}


def go(rig, record, seed=1, watcher=None, **chosen):
    watcher = watcher or Watcher()
    with record.open():
        done = run(
            Aberration(), rig, Parameters(**{**CHOSEN, **chosen}), seed=seed, record=record, calibration={},
            observer=watcher,
        )  # fmt: skip
    return done, watcher


def record_in(directory):
    return RunRecord.create(directory, "aberration", config="", identity={})


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """One run that several tests look at; it was interrupted after the push, and resumed."""
    record = record_in(tmp_path_factory.mktemp("runs"))
    with pytest.raises(Interrupted):
        go(SimulatedRig(tables(**OUT)), record, watcher=Watcher(stop_at=4))
    return go(SimulatedRig(tables(**OUT)), RunRecord.reopen(record.directory))


def test_a_bench_out_of_line_is_corrected_without_a_model(found):
    done, watcher = found
    result = done.result
    assert result["frames"] <= 125
    assert watcher.judged[-1].outcome is Outcome.TARGET_MET
    truth = result["truth"]
    assert truth["before_rms_rad"]["median"] > 0.3
    assert truth["residual_rms_rad"]["median"] <= 0.05
    assert truth["zones_own_residual_rms_rad"]["median"] <= 0.05
    assert truth["residual_rms_rad"]["worst"] < 0.2  # a corner that the pupil's rim cuts
    assert result["targets_met"]
    assert result["after"]["median"]["sharpness"] > result["before"]["median"]["sharpness"] + 0.15


def test_the_wavefront_before_is_what_the_bench_has(found):
    result = found[0].result
    truth = result["truth"]["before_rms_rad"]["zones"]
    off = [
        zone["wavefront_rms_rad"] / true - 1
        for zone, true in zip(result["before"]["zones"], truth, strict=True)
        if zone["valid"]
    ]
    assert len(off) >= 7
    assert abs(np.median(off)) < 0.15  # the part of the pupil that is lit is the nominal bench's


def test_what_is_left_is_measured_on_fresh_frames_and_with_an_error(found):
    result = found[0].result
    zones = result["after"]["zones"]
    left = [zone["wavefront_rms_rad"] for zone in zones if zone["valid"]]
    error = [zone["wavefront_sigma_rad"] for zone in zones if zone["valid"]]
    assert 0 < np.median(left) < 0.05
    assert 0.002 < np.median(error) < 0.05
    assert set(zones[4]) == set(result["before"]["zones"][4])
    assert set(zones[4]["coefficients_rad"]) == {str(j) for j in range(4, 16)}
    assert all(zone["valid"] or zone["reason"] for zone in zones)


def test_the_maps_are_those_that_render_uses(found):
    done, _ = found
    accepted = Accepted("aberration", "entry", "", done.result, read_maps(done.directory / "maps.exr"))
    field_rad = float(np.radians(SMALL["camera.field_deg"]))
    wavefront = corrections_of({"aberration": accepted}, fov_rad=(field_rad, field_rad)).wavefront
    assert wavefront is not None
    assert not wavefront.is_identity()
    assert done.result["mode"] == "search"


def steps_of(directory):
    return [line["progress"] | {"shots": line["shots"]} for line in read_journal(directory) if line["event"] == "step"]


def test_a_resumed_run_goes_on_as_an_unbroken_one(tmp_path, found):
    """The run that is looked at was interrupted after the push; without that the next step is the same to the digit."""
    with pytest.raises(Interrupted):
        go(SimulatedRig(tables(**OUT)), (record := record_in(tmp_path)), watcher=Watcher(stop_at=5))
    unbroken, resumed = steps_of(record.directory), steps_of(found[0].directory)
    assert len(unbroken) == 5
    assert unbroken == resumed[:5]
    assert unbroken[4]["last_step_rad"] > 0


def test_a_state_in_the_middle_of_a_search_survives_the_checkpoint(tmp_path):
    with pytest.raises(Interrupted):
        go(SimulatedRig(tables(**OUT)), (record := record_in(tmp_path)), watcher=Watcher(stop_at=2))
    state, _ = record.resume()
    again = state_from_bytes(state_bytes(state))
    assert again.plan.trial_noll == state.plan.trial_noll
    assert np.array_equal(again.search.tilt_rad, state.search.tilt_rad)
    assert again.windows.reasons == state.windows.reasons


def test_the_plan_stays_within_125_frames():
    facts = SimulatedRig(tables(**OUT)).facts()
    planned = Aberration().plan(facts, Parameters(mode="search"))
    assert planned.frames == 86
    assert "32 more" in planned.sentences[2]  # 118 with three pushes


def test_zones_too_near_for_a_window_each_are_refused_before_the_light_goes_on():
    facts = SimulatedRig(tables()).facts()
    for mode in ("search", "sweep"):
        with pytest.raises(RefusedError, match="camera pixels for each spot's window"):
            Aberration().start(facts, {}, Parameters(mode=mode, zones=13), 1)


def test_a_perfect_spot_has_the_sharpness_one_and_moves_as_the_tilt_says():
    rig = SimulatedRig(tables(**OUT))
    state = Aberration().start(rig.facts(), {}, Parameters(**CHOSEN), 1).spots
    array = array_of(state)
    lit = lit_pupils(array, [4])[0]
    assert array.panel == Panel(960, 540, 3.74e-6)
    moves = gradient_to_place(array)
    # lambda / pixel of gradient: one wave across the pupil's radius turns light by lambda / radius
    waves = 2 * np.pi * np.linalg.norm(moves[:, 0]) * array.pixel_tan
    assert waves == pytest.approx(515e-9 / 1.5e-3, rel=1e-6)
    assert moves[0, 0] < 0 < moves[1, 1]

    class Here:
        px_per_gradient, side = moves, 17

    whole = ideal_concentration(state, Here, lit, np.zeros(2))
    assert 0.05 < whole < 1.0
    assert ideal_concentration(state, Here, lit, np.array([0.5, 0.5])) < whole
