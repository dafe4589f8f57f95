"""The number that says how uneven a field is: against fields whose unevenness is known."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import frames_of, generator

from holocal.errors import InputError
from holocal.estimate.uniformity import inscribed_rectangle, measure_uniformity

SIZE, BLOCK = 495, 33
EVERYWHERE = np.ones((SIZE, SIZE), bool)
SPECKLES = [(0.45, 0.0), (0.8, 2.0)]  # contrast, width of a grain in pixels


def wavy(rms: float) -> np.ndarray:
    """A field with this standard deviation over its mean, in waves far longer than a block."""
    x, y = np.meshgrid(np.arange(SIZE) / SIZE, np.arange(SIZE) / SIZE)
    waves = np.sin(2 * np.pi * (2 * x + 0.1)) + 0.6 * np.cos(2 * np.pi * (x - 2 * y))
    waves -= waves.mean()
    return 1 + rms * waves / waves.std()


@pytest.mark.parametrize(("contrast", "grain_px"), SPECKLES)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_even_field_under_speckle_is_even_within_its_sigma(seed, contrast, grain_px):
    pictures = frames_of(np.ones((SIZE, SIZE)), seed, 3, contrast=contrast, grain_px=grain_px)
    found = measure_uniformity(pictures, EVERYWHERE, block_px=BLOCK)
    # What is normal is the variance: 3 of its standard errors are 6 of the root's, as d(rms^2) = 2 rms d(rms).
    assert found.rms <= 6 * found.rms_sigma
    assert found.rms_sigma < 0.02  # 5 % of noise per block at most, a third of its variance known to 10 %
    assert found.mean == pytest.approx(400, rel=0.01)


@pytest.mark.parametrize(("contrast", "grain_px"), SPECKLES)
@pytest.mark.parametrize("seed", [4, 5, 6])
def test_three_per_cent_are_found_to_be_three_per_cent(seed, contrast, grain_px):
    pictures = frames_of(wavy(0.03), seed, 3, contrast=contrast, grain_px=grain_px)
    pictures *= np.array([1.0, 0.7, 1.6])[:, None, None]  # frames of unlike power count alike
    found = measure_uniformity(pictures, EVERYWHERE, block_px=BLOCK)
    assert abs(found.rms - 0.03) < 3 * found.rms_sigma
    assert found.rms_sigma < 0.01  # a third of what is measured: it says something


def test_without_speckle_the_rms_is_that_of_the_block_means():
    found = measure_uniformity(wavy(0.03)[None], EVERYWHERE, block_px=BLOCK)
    assert found.rms == pytest.approx(0.03, rel=0.05)  # blocks of a fifteenth of a wave pair average 1 % of it away


def test_nine_points_of_a_gradient_are_where_the_standard_has_them():
    x, y = np.meshgrid(np.arange(SIZE) / SIZE, np.arange(SIZE) / SIZE)
    found = measure_uniformity((1 + 0.3 * x + 0.15 * y)[None], EVERYWHERE, block_px=BLOCK)
    lowest, highest = 1 + 0.45 / 6, 1 + 0.45 * 5 / 6
    assert found.nine_point == pytest.approx(1 - lowest / highest, abs=0.002)  # a point is placed to a pixel or four


def test_the_largest_rectangle_in_a_disc_is_its_square():
    x, y = np.meshgrid(np.arange(400), np.arange(400))
    disc = np.hypot(x - 210, y - 190) <= 150
    top, bottom, left, right = inscribed_rectangle(disc)
    assert disc[top:bottom, left:right].all()
    # Cells of four pixels that the circle cuts are left out; a rectangle near the square is nearly as large as it.
    assert (bottom - top) * (right - left) == pytest.approx(2 * 150**2, rel=0.06)
    assert (bottom - top) / (right - left) == pytest.approx(1, abs=0.25)


def test_the_largest_rectangle_of_scattered_holes_is_valid_everywhere():
    valid = np.ones((200, 300), bool)
    for row, column in generator(9).integers(0, (200, 300), (12, 2)):
        valid[max(row - 6, 0) : row + 6, max(column - 6, 0) : column + 6] = False
    top, bottom, left, right = inscribed_rectangle(valid)
    assert valid[top:bottom, left:right].all()
    assert (bottom - top) * (right - left) > 100 * 60


def test_too_small_a_field_is_refused_with_its_blocks_counted():
    small = np.zeros((SIZE, SIZE), bool)
    small[:70, :70] = True
    with pytest.raises(InputError, match="4 blocks of 33 pixels") as caught:
        measure_uniformity(np.ones((1, SIZE, SIZE)), small, block_px=BLOCK)
    assert (caught.value.measured, caught.value.limit) == (4, 9)


def test_a_picture_without_light_is_refused():
    with pytest.raises(InputError, match="no light"):
        measure_uniformity(np.zeros((1, SIZE, SIZE)), EVERYWHERE, block_px=BLOCK)
