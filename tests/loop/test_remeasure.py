"""What an accepted calibration leaves, measured again in a few frames, on the simulated bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holocal.errors import RefusedError
from holocal.loop.checking import recheck
from holocal.loop.preflight import preflight
from holocal.loop.shooting import Shooter
from holocal.records.calibration import Accepted
from holocal.records.maps import Maps
from holocal.records.rig import load_rig
from procedures.aberration import Aberration
from procedures.aberration import Parameters as AberrationParameters
from procedures.distortion import Distortion
from procedures.distortion import Parameters as DistortionParameters
from procedures.response import Parameters as ResponseParameters
from procedures.response import Response
from procedures.uniformity import Parameters as UniformityParameters
from procedures.uniformity import Uniformity
from rigs.simulated.rig import SimulatedRig

EXTENT = (-12.5, 12.5, -12.5, 12.5)
LEVEL = np.arange(256) * (2 * np.pi / 256)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A bench after its pre-flight."""
    rig = SimulatedRig(load_rig("simulated-small"))
    shooter = Shooter(rig, rig.facts(), lambda *_: None)
    preflight(shooter, rig.facts(), None, tmp_path_factory.mktemp("run"))
    yield rig, shooter
    rig.close()


def accepted(procedure: str, channels: dict[str, np.ndarray], result: dict, **metadata: object) -> dict[str, Accepted]:
    maps = Maps({name: values.astype(np.float32) for name, values in channels.items()}, metadata)
    return {procedure: Accepted(procedure, "entry", "", result, maps)}


def found_of(bench, procedure, calibration, parameters):
    rig, shooter = bench
    return recheck(procedure, rig, shooter, calibration, parameters, reference=shooter.reference, seed=3, step=0)


def response(bench, table):
    exposure_s = 0.05
    calibration = accepted("response", {"correction.phase_rad": table[None]}, {"exposure_s": exposure_s})
    return found_of(bench, Response(), calibration, ResponseParameters())


def test_a_response_that_is_right_is_found_right_and_one_that_is_bent_by_so_much(bench):
    right = response(bench, LEVEL)
    assert right.frames == 12
    assert right.found.after["phase_error_rms_rad"] < 0.005
    bent = response(bench, LEVEL + 0.1 * np.sin(LEVEL))
    expected = 0.1 / np.sqrt(2)
    assert bent.found.after["phase_error_rms_rad"] == pytest.approx(expected, rel=0.3)
    assert bent.found.sigma["phase_error_rms_rad"] < 0.5 * expected


def test_a_response_that_falls_is_compared_with_its_own_sign(bench):
    """The panel's phase rises: a table that falls is measured as its mirror image, and is as right."""
    assert response(bench, -LEVEL).found.after["phase_error_rms_rad"] < 0.005


def test_an_uncorrected_field_is_uneven_over_what_is_valid(bench):
    camera = bench[0].facts().camera
    shape = (camera.height, camera.width)
    valid = np.zeros(shape)
    valid[200:500, 250:550] = 1
    channels = {"correction.intensity_weight": np.ones(shape), "valid": valid}
    calibration = accepted("uniformity", channels, {"exposure_s": 0.02}, extent_deg=EXTENT)
    again = found_of(bench, Uniformity(), calibration, UniformityParameters())
    assert again.frames == 4  # one without light
    assert again.found.after["nonuniformity_rms"] > 0.1
    assert 0 < again.found.sigma["nonuniformity_rms"] < 0.05


def distortion(bench, shift_x):
    nothing = np.zeros((150, 150))
    channels = {"correction.shift_tan_x": nothing + shift_x, "correction.shift_tan_y": nothing, "valid": nothing + 1}
    calibration = accepted("distortion", channels, {"exposures_s": [0.004]}, extent_deg=EXTENT)
    return found_of(bench, Distortion(), calibration, DistortionParameters())


def test_an_uncorrected_picture_is_as_far_off_as_the_bench_bends_it(bench):
    again = distortion(bench, 0.0)
    assert again.frames == 2
    assert 20 < again.found.after["rms_px"] < 60
    pixel_tan = 2 * np.tan(np.radians(12.5)) / 750
    moved = distortion(bench, 20 * pixel_tan)
    assert abs(moved.found.after["rms_px"] - again.found.after["rms_px"]) > 2


def test_an_uncorrected_wavefront_is_the_benchs_own(bench):
    parameters = AberrationParameters()
    terms = np.zeros((len(parameters.noll), 15))
    result = {"field": {"coefficients_rad": terms.tolist()}, "zones_believed": 9}
    again = found_of(bench, Aberration(), accepted("aberration", {"x": np.zeros((1, 1))}, result), parameters)
    assert again.frames == 3
    assert again.found.after["median_wavefront_rms_rad"] == pytest.approx(0.112, abs=0.04)  # of a whole run
    assert 0 < again.found.sigma["median_wavefront_rms_rad"] < 0.05


def test_a_dark_bench_does_not_show_the_calibration(bench):
    """Too few zones: the reason is told, and no number is made up."""
    parameters = AberrationParameters()
    result = {"field": {"coefficients_rad": np.zeros((len(parameters.noll), 15)).tolist()}, "zones_believed": 25}
    again = found_of(bench, Aberration(), accepted("aberration", {"x": np.zeros((1, 1))}, result), parameters)
    assert again.found is None
    assert "of 25 when it was accepted" in again.reason


def test_a_shooter_that_fails_is_not_a_drift(bench):
    rig, shooter = bench

    def refuse(shot):
        raise RefusedError("the camera is another's.")

    broken = replace(shooter)
    broken.shoot = refuse
    with pytest.raises(RefusedError, match="another's"):
        response((rig, broken), LEVEL)
