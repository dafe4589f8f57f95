"""The procedure `aberration`, whole, through the runner, on the simulated bench with a small panel."""

from __future__ import annotations

import numpy as np
import pytest

from holocal.app.corrections import corrections_of
from holocal.errors import Interrupted, RefusedError
from holocal.hologram.phase_model import wanted_phase
from holocal.hologram.settings import HologramSettings
from holocal.loop.checkpoint import state_bytes, state_from_bytes
from holocal.loop.procedure import Outcome
from holocal.loop.record import RunRecord
from holocal.loop.runner import run
from holocal.optics.bench import Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.records.calibration import Accepted
from holocal.records.maps import read_maps
from holocal.records.rig import load_rig
from procedures._aberration_truth import residuals_rad
from procedures.aberration import Aberration, Parameters
from rigs.simulated.optics import bench_of
from rigs.simulated.rig import SimulatedRig

SMALL = {"camera.width": 360, "camera.height": 360, "camera.field_deg": 12.0, "camera.bits": 10}
FAR = {"misalignment.slm_shift_mm": [0.2, -0.1, 3.0], "misalignment.mirror_rotation_deg": [0.1, -0.1, 0.05]}


class Watcher:
    """Remembers what was judged; pulls the plug after a step if told to."""

    def __init__(self, stop_at=None):
        self.judged, self.stop_at = [], stop_at

    def preflight(self, checks, seconds): ...

    def waiting(self, what): ...

    def incident(self, sentence): ...

    def step(self, number, progress, judgement):
        self.judged.append(judgement)
        if number == self.stop_at:
            raise KeyboardInterrupt


def tables(**changed):
    return load_rig("simulated-small", {**SMALL, **FAR, **{k.replace("__", "."): v for k, v in changed.items()}})


def go(rig, directory, seed=1, watcher=None, record=None, **chosen):
    watcher = watcher or Watcher()
    record = record or RunRecord.create(directory, "aberration", config="", identity={})
    with record.open():
        done = run(
            Aberration(), rig, Parameters(**{"zones": 3, **chosen}), seed=seed, record=record, calibration={},
            observer=watcher,
        )  # fmt: skip
    return done, watcher


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """One run that several tests look at."""
    return go(SimulatedRig(tables()), tmp_path_factory.mktemp("runs"))


def test_a_bench_out_of_line_is_corrected_in_six_frames(found):
    done, watcher = found
    result = done.result
    assert result["frames"] == 6
    assert watcher.judged[-1].outcome is Outcome.TARGET_MET
    assert result["targets_met"]
    truth = result["truth"]
    assert truth["before_rms_rad"]["median"] > 0.5
    assert truth["residual_rms_rad"]["median"] < 0.03
    assert truth["residual_rms_rad"]["worst"] < 0.1
    assert result["after"]["median"]["sharpness"] > result["before"]["median"]["sharpness"]
    zones = result["before"]["zones"]
    assert len(zones) == 9 and {"coefficients_rad", "sigma_rad", "sharpness", "wavefront_rms_rad"} <= set(zones[0])
    assert set(zones[4]["coefficients_rad"]) == {str(j) for j in range(4, 16)}


@pytest.mark.slow
def test_the_posterior_of_a_zone_confirms_its_laplace_errors(tmp_path):
    done, _ = go(SimulatedRig(tables()), tmp_path, posterior=True)
    said = done.result["posterior"]
    assert said["converged"] and 0.2 < said["acceptance"] < 0.8
    assert said["autocorrelation_steps"] < 12
    assert 0.9 < said["sigma_ratio"]["least"] <= said["sigma_ratio"]["most"] < 1.3


def test_the_wavefront_before_is_what_the_bench_has(found):
    result = found[0].result
    for zone, true in zip(result["before"]["zones"], result["truth"]["before_rms_rad"]["zones"], strict=True):
        if zone["valid"]:
            # 8 % more in a zone that the pupil's rim cuts: the estimate's box round the lit part is a little wider
            assert zone["wavefront_rms_rad"] == pytest.approx(true, rel=0.25, abs=0.02)


def test_the_correction_that_render_uses_undoes_the_bench(found):
    """Through the maps, as `accept` and `render` have it, at another wavelength: a path is a path."""
    done, _ = found
    accepted = Accepted("aberration", "entry", "", done.result, read_maps(done.directory / "maps.exr"))
    field_rad = float(np.radians(12.0))
    wavefront = corrections_of({"aberration": accepted}, fov_rad=(field_rad, field_rad)).wavefront
    assert wavefront is not None
    panel, nominal, bench = Panel(960, 540, 3.74e-6), Bench.nominal(), bench_of(tables().simulated)
    settings = HologramSettings(panel, nominal, 639e-9, (field_rad, field_rad), wavefront=wavefront)
    tangent = np.array([0.02, -0.03])  # in no zone's middle
    half = np.array(panel.half_size_m)
    at = np.linspace(-0.95, 0.95, 21)
    slm = np.stack(np.meshgrid(at * half[0], at * half[1]), axis=-1).reshape(-1, 2)
    shown = wanted_phase(settings, VirtualPoints.at(tangent), slm).phase_rad
    plain = exact_phase(nominal, VirtualPoints.at(tangent), slm, wavelength_m=639e-9).phase_rad

    def left(phase):
        seen = tangent.copy()
        for _ in range(10):  # the direction that the spot is seen along
            real = exact_phase(bench, VirtualPoints.at(seen), slm, wavelength_m=639e-9)
            plane = np.concatenate([np.ones((len(slm), 1)), 1e3 * real.pupil_m], axis=1)
            error = phase - real.phase_rad
            coefficients = np.linalg.lstsq(plane, error - error.mean(), rcond=None)[0]
            sines = seen / np.sqrt(1 + seen @ seen) - 1e3 * coefficients[1:] * 639e-9 / (2 * np.pi)
            seen = sines / np.sqrt(1 - sines @ sines)
        rest = error - error.mean() - plane @ coefficients
        return float(np.std(rest - rest.mean()))

    assert left(plain) > 0.5
    assert left(shown) < 0.06


def test_a_dark_zone_is_reported_and_takes_the_others_prediction(tmp_path):
    done, _ = go(SimulatedRig(tables(camera__field_deg=20.0, camera__width=600, camera__height=600)), tmp_path)
    zones = done.result["before"]["zones"]
    dark = [zone for zone in zones if not zone["valid"]]
    assert dark and all(zone["reason"] for zone in dark)
    assert all(np.isfinite(list(zone["coefficients_rad"].values())).all() for zone in dark)
    assert done.result["truth"]["residual_rms_rad"]["median"] < 0.1  # four zones, on a tenth of the pupil


def test_a_run_that_is_interrupted_ends_as_an_unbroken_one(tmp_path, found):
    record = RunRecord.create(tmp_path, "aberration", config="", identity={})
    with pytest.raises(Interrupted):
        go(SimulatedRig(tables()), tmp_path, record=record, watcher=Watcher(stop_at=1))
    done, _ = go(SimulatedRig(tables()), tmp_path, record=RunRecord.reopen(record.directory))
    for key in ("before", "after", "field"):
        assert done.result[key] == found[0].result[key]


def test_the_state_survives_the_checkpoint():
    rig = SimulatedRig(tables())
    state = Aberration().start(rig.facts(), {}, Parameters(zones=3), 1)
    again = state_from_bytes(state_bytes(state))
    assert again.facts == state.facts and np.array_equal(again.next_gain, state.next_gain)


def test_a_camera_that_sees_no_spots_is_refused(tmp_path):
    rig = SimulatedRig(tables())
    grab = rig.camera.grab

    class Blind(Aberration):
        def start(self, *given):
            def elsewhere():
                frame = grab()
                counts = np.full_like(frame.counts, 40)
                counts[:3] += np.random.default_rng(frame.frame_id).integers(0, 900, counts[:3].shape).astype(np.uint16)
                return type(frame)(counts, frame.exposure_s, frame.frame_id, 0.0, 0)

            rig.camera.grab = elsewhere
            return super().start(*given)

    record = RunRecord.create(tmp_path, "aberration", config="", identity={})
    with record.open(), pytest.raises(RefusedError, match="spots were found"):
        run(Blind(), rig, Parameters(zones=3), seed=1, record=record, calibration={}, observer=Watcher())


def test_the_truth_of_an_aligned_bench_is_no_aberration():
    truth = {"misalignment": {f"{a}_{b}": [0.0] * 3 for a in ("mirror", "slm") for b in ("rotation_deg", "shift_mm")}}
    left = residuals_rad(
        Bench.nominal(), Panel(960, 540, 3.74e-6), truth, np.array([[0.0, 0.0], [0.05, -0.04]]),
        wavelength_m=515e-9, noll=(4,), coefficients_rad=np.array([[0.0], [0.5]]),
    )  # fmt: skip
    assert left[0] < 1e-6
    assert left[1] > 0.02  # half a radian of the whole pupil's defocus, over the small part that the panel lights
