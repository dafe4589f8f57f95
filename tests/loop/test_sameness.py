"""A panel that kept its pattern, by the camera alone: photon transfer, and two pictures against their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import generator, speckle, uneven_field

from holocal.loop import gates
from holocal.loop.devices import Frame
from holocal.loop.reference import Reference, make_reference
from holocal.loop.sameness import sameness
from holocal.records.facts import CameraFacts

HEIGHT, WIDTH = 96, 128
FULL_SCALE = 4095
CAMERA = CameraFacts(WIDTH, HEIGHT, (0.4, 0.3), FULL_SCALE, 1e-5, 10.0)
OFFSET, READ, GAIN = 40.0, 3.0, 0.5  # counts, counts rms, counts per electron
RATE = 1e5  # counts per second of the field's brightest part


def picture(number: int, *, contrast: float = 0.45, field: np.ndarray | None = None) -> np.ndarray:
    """A field from 1/4 to 1, with the speckle of a pattern of this number."""
    shape = uneven_field(HEIGHT, WIDTH) if field is None else field
    return shape * speckle(generator(number), HEIGHT, WIDTH, contrast=contrast, grain_px=1.0)


def frame(light: np.ndarray | float, exposure_s: float, noise: int, *, hot: bool = True) -> Frame:
    """A frame of counts: shot noise, read noise, an offset, and hot pixels."""
    rng = generator(77, noise)
    electrons = rng.poisson(np.asarray(light) * RATE * exposure_s / GAIN * np.ones((HEIGHT, WIDTH)))
    counts = OFFSET + GAIN * electrons + rng.normal(0, READ, (HEIGHT, WIDTH))
    if hot:
        counts[::17, ::23] += 2000
    counts = np.clip(np.rint(counts), 0, FULL_SCALE).astype(np.uint16)
    return Frame(counts, exposure_s, noise, float(np.mean(counts >= FULL_SCALE)))


@pytest.fixture(scope="module")
def reference() -> Reference:
    darks = frame(0.0, 1e-4, 1), frame(0.0, 5e-3, 2)
    return make_reference(darks, [frame(picture(1), 5e-3, number) for number in (3, 4, 5, 6)])


def test_photon_transfer_finds_gain_read_noise_and_dark_level(reference):
    # 12,000 pixels, three differences: 1.5 % of the gain; rounding adds 1/12 to the variance of reading.
    assert reference.gain == pytest.approx(GAIN, rel=0.04)
    assert reference.read_variance == pytest.approx(READ**2 + 1 / 12, rel=0.03)
    assert reference.dark_level(5e-3) == pytest.approx(OFFSET, abs=0.1)
    assert reference.rate == pytest.approx(RATE * picture(1).mean(), rel=0.01)
    assert reference.noisy
    hot = np.zeros((HEIGHT, WIDTH), bool)
    hot[::17, ::23] = True
    assert np.array_equal(reference.usable, ~hot)


def test_flicker_of_the_whole_light_is_no_noise_and_flicker_of_each_pixel_is():
    darks = frame(0.0, 1e-4, 1), frame(0.0, 5e-3, 2)
    drifting = make_reference(darks, [frame(picture(1) * (1 + 0.02 * n), 5e-3, 3 + n) for n in range(4)])
    assert drifting.gain == pytest.approx(GAIN, rel=0.04)
    shaken = [picture(1) * generator(5, n).normal(1, 0.1, (HEIGHT, WIDTH)).clip(0) for n in range(4)]
    found = make_reference(darks, [frame(light, 5e-3, 3 + n) for n, light in enumerate(shaken)])
    assert np.sqrt(found.flicker_squared) == pytest.approx(0.1, rel=0.1)


@settings(max_examples=25, deadline=None)
@given(
    before_s=st.floats(2e-4, 8e-3),
    after_s=st.floats(2e-4, 8e-3),
    drift=st.floats(0.7, 1.3),
    seed=st.integers(10, 10**6),
)
def test_one_pattern_differs_by_its_noise_whatever_the_exposures(reference, before_s, after_s, drift, seed):
    light = picture(seed)
    found = sameness(frame(light, before_s, seed), frame(drift * light, after_s, seed + 1), reference, FULL_SCALE)
    assert found is not None
    # 11,000 pixels: 1.4 % of a variance; gain and read noise are known to 3 %; clipped tails are left out.
    assert found.difference == pytest.approx(1.0, abs=0.12)


@settings(max_examples=25, deadline=None)
@given(
    before_s=st.floats(2e-4, 8e-3),
    after_s=st.floats(2e-4, 8e-3),
    drift=st.floats(0.7, 1.3),
    seed=st.integers(10, 10**6),
)
def test_another_pattern_never_passes_for_the_same(reference, before_s, after_s, drift, seed):
    before, after = frame(picture(seed), before_s, seed), frame(drift * picture(seed + 1), after_s, seed + 1)
    found = sameness(before, after, reference, FULL_SCALE)
    assert found is not None
    # Independent speckle has a difference of 1 + its structure; the sum of two samples of heavy-tailed speckle varies.
    assert found.difference == pytest.approx(1 + found.structure, rel=0.15)
    assert gates.unchanged(after, before, reference, CAMERA).ok


def test_a_kept_pattern_trips_the_gate_and_says_the_number(reference):
    before, after = frame(picture(8), 2e-3, 8), frame(picture(8), 5e-3, 9)
    verdict = gates.unchanged(after, before, reference, CAMERA)
    assert not verdict.ok and verdict.gate == "unchanged"
    assert verdict.measured == pytest.approx(1.0, abs=0.1) and verdict.limit == 2.0


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (0.0, 0.0),  # dark pairs
        (picture(1) * 1e-3, picture(2) * 1e-3),  # so faint that noise hides the speckle, another pattern or the same
        (picture(1) * 1e-3, picture(1) * 1e-3),
        (uneven_field(HEIGHT, WIDTH), uneven_field(HEIGHT, WIDTH)),  # no speckle: nothing tells two patterns apart
        (picture(1), 0.0),  # the light went out: another gate's
    ],
)
def test_where_pictures_cannot_tell_patterns_apart_the_gate_stays_shut(reference, before, after):
    assert gates.unchanged(frame(after, 5e-3, 21), frame(before, 5e-3, 20), reference, CAMERA).ok


def test_a_half_changed_picture_is_a_changed_one(reference):
    half = picture(1).copy()
    half[:, : WIDTH // 2] = picture(2)[:, : WIDTH // 2]
    assert gates.unchanged(frame(half, 5e-3, 31), frame(picture(1), 5e-3, 30), reference, CAMERA).ok


def test_a_light_that_went_out_trips_its_gate_where_it_would_be_seen(reference):
    out = gates.unlit(frame(0.0, 5e-3, 40), reference)
    assert not out.ok and abs(out.measured) < 0.01
    assert gates.unlit(frame(picture(3) * 0.2, 5e-3, 41), reference).ok
    assert gates.unlit(frame(0.0, 5e-5, 42), reference).ok  # 1.6 counts are expected: less than a black level may move


def test_frames_that_are_alike_bit_by_bit_are_bad_even_of_one_pattern_where_there_is_noise(reference):
    again = replace(frame(picture(1), 5e-3, 50), frame_id=51)
    around = gates.Surroundings(last=frame(picture(1), 5e-3, 50), changed=False, reference=reference)
    found = gates.first_failure(again, CAMERA, around)
    assert found is not None and found.gate == "identical"
    quiet = replace(around, reference=replace(reference, noisy=False))
    assert gates.first_failure(again, CAMERA, quiet) is None


def test_a_shot_that_need_not_be_fresh_is_not_asked_for_light_nor_for_change(reference):
    dark = frame(0.0, 5e-3, 60)
    around = gates.Surroundings(last=frame(picture(1), 5e-3, 59), reference=reference)
    found = gates.first_failure(dark, CAMERA, around)
    assert found is not None and found.gate == "unlit"
    assert gates.first_failure(dark, CAMERA, replace(around, fresh=False)) is None
