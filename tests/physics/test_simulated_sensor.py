"""The simulated sensor: the statistics of its counts, and that they are the same again."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from holocal.records.rig import load_rig
from rigs.simulated.rig import SimulatedRig
from rigs.simulated.sensor import Sensor, stream

QUIET = Sensor(200, 160, 12, 10000.0, 0.0, 0.0, shot_noise=True, hot_pixels=0, psf_px=0.0, seed=3)
PIXELS = QUIET.width * QUIET.height
ONE_EACH = replace(QUIET, bits=16, full_well_e=65535.0)  # a count is an electron


def evenly(sensor, electrons, exposure_s=0.1, key=("even",)):
    """Counts of evenly lit pixels that get so many electrons on average."""
    rate = np.full((sensor.height, sensor.width), electrons / exposure_s, np.float32)
    return sensor.expose(rate, exposure_s, key).astype(float)


@pytest.mark.parametrize("electrons", [0.05, 3.0, 60.0, 101.0, 400.0, 20000.0])
def test_counts_of_shot_noise_follow_poissons_law(electrons):
    counts = evenly(ONE_EACH, electrons).ravel()
    at = np.unique(counts)
    found = np.searchsorted(np.sort(counts), at, side="right") / counts.size
    # the largest distance of the distributions is below 1.95 / sqrt(n) for all but one sample in a thousand
    assert np.abs(found - stats.poisson.cdf(at, electrons)).max() < 1.95 / np.sqrt(PIXELS)


@pytest.mark.parametrize("electrons", [0.0, 40.0, 150.0, 3000.0])
def test_variance_is_that_of_the_photon_transfer_curve(electrons):
    sensor = replace(QUIET, read_noise_e=6.0)
    gain = sensor.full_scale / sensor.full_well_e  # counts per electron
    counts = evenly(sensor, electrons)
    wanted = gain**2 * (electrons + 36.0) + 1 / 12  # rounding to whole counts
    assert counts.var() == pytest.approx(wanted, rel=4 * np.sqrt(2 / PIXELS))  # 4 standard errors of a variance
    assert counts.mean() == pytest.approx(gain * (electrons + sensor.offset_e), abs=4 * np.sqrt(wanted / PIXELS))


def test_without_shot_noise_the_same_light_gives_the_same_count():
    assert np.ptp(evenly(replace(QUIET, shot_noise=False), 1234.0)) == 0


def test_a_full_well_saturates_at_the_largest_count():
    sensor = replace(QUIET, shot_noise=False)
    assert np.all(evenly(sensor, 9000.0) == round(9000 * 4095 / 10000))
    assert np.all(evenly(sensor, 10000.0) == 4095)
    assert np.all(evenly(sensor, 40000.0) == 4095)


def test_hot_pixels_stay_where_the_rigs_seed_put_them_and_grow_with_exposure():
    sensor = replace(QUIET, dark_e_per_s=5.0, hot_pixels=12)
    short, long = (evenly(sensor, 0.0, exposure_s=s, key=(s,)) for s in (0.5, 1.0))
    bright = sensor.dark_current >= 500  # 100 to 10,000 times the dark current of 5 e/s
    assert bright.sum() == 12
    assert set(zip(*np.nonzero(long > 50), strict=True)) == set(zip(*np.nonzero(bright), strict=True))
    assert np.allclose(long[bright], np.minimum(2 * short[bright], 4095), rtol=0.25, atol=60)
    assert not np.array_equal(bright, replace(sensor, seed=4).dark_current >= 500)


def test_dark_current_fills_the_dark_frame():
    sensor = replace(ONE_EACH, dark_e_per_s=50.0)
    assert evenly(sensor, 0.0, exposure_s=2.0).mean() == pytest.approx(100.0, rel=4 / np.sqrt(100 * PIXELS))


def test_the_lens_blurs_a_point_to_a_gaussian_of_the_given_width():
    sensor = replace(ONE_EACH, shot_noise=False, psf_px=1.5)
    rate = np.zeros((sensor.height, sensor.width), np.float32)
    rate[70, 90] = 50000.0
    counts = sensor.expose(rate, 1.0, ("point",)).astype(float)
    y, x = np.indices(counts.shape)
    for axis, centre in ((x, 90), (y, 70)):
        assert np.sum(counts * (axis - centre) ** 2) / counts.sum() == pytest.approx(1.5**2, rel=0.02)  # whole counts
    assert counts.sum() == pytest.approx(50000, rel=0.01)


def test_noise_belongs_to_the_seed_and_to_the_frame():
    sensor = replace(QUIET, read_noise_e=6.0)
    first = evenly(sensor, 500.0, key=("frame", 1))
    assert np.array_equal(first, evenly(sensor, 500.0, key=("frame", 1)))
    assert not np.array_equal(first, evenly(sensor, 500.0, key=("frame", 2)))
    assert not np.array_equal(first, evenly(replace(sensor, seed=4), 500.0, key=("frame", 1)))


def test_the_bands_that_are_drawn_side_by_side_have_noise_of_their_own():
    counts = evenly(QUIET, 500.0)
    bands = [counts[i * 20 : (i + 1) * 20].ravel() for i in range(8)]
    assert np.abs(np.corrcoef(bands) - np.eye(8)).max() < 5 / np.sqrt(20 * 200)  # 5 standard errors


TINY = [
    *("slm.width=120", "slm.height=72", "camera.width=24", "camera.height=20", "camera.field_deg=3.0"),
    *("optics.wavelengths_nm=[515]", "camera.read_noise_e=4.0", "camera.shot_noise=true"),
]


def frames(*overrides, grabs=2):
    rig = SimulatedRig(load_rig("simulated-ideal", [*TINY, *overrides]))
    rig.slm.show(np.random.default_rng(0).integers(0, 256, (72, 120), dtype=np.uint8))
    rig.light.on()
    rig.camera.set_exposure(0.5)
    return [rig.camera.grab().counts for _ in range(grabs)]


def test_a_rig_of_the_same_seed_gives_the_same_bytes_and_each_grab_its_own_noise():
    first, second = frames()
    again = frames()
    assert first.tobytes() == again[0].tobytes() and second.tobytes() == again[1].tobytes()
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, frames("seed=1", grabs=1)[0])


def test_power_noise_scales_whole_frames_by_its_rms():
    quiet = ("camera.read_noise_e=0.0", "camera.shot_noise=false", "camera.bits=16", "camera.full_well_e=65535.0")
    steady = frames(*quiet, grabs=1)[0].astype(float)
    grabs = frames(*quiet, "illumination.power_noise=0.05", grabs=200)
    factors = np.array([np.sum(grab * steady) / np.sum(steady**2) for grab in grabs])
    assert np.abs(grabs[0] - factors[0] * steady).max() < 1.1  # one factor; both are rounded to whole counts
    assert factors.std() == pytest.approx(0.05, rel=4 / np.sqrt(2 * 200))  # 4 standard errors
    assert factors.mean() == pytest.approx(1, abs=4 * 0.05 / np.sqrt(200))
    again = frames(*quiet, "illumination.power_noise=0.05", grabs=3)
    assert all(np.array_equal(a, b) for a, b in zip(grabs, again, strict=False))


def test_streams_of_one_frame_differ():
    draws = [stream(0, ("frame",), part).standard_normal() for part in (*range(8), 0xF11C)]
    assert len(set(draws)) == 9
