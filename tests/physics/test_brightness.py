"""The brightness map: against plain sums, against OpenCV's literal pipeline, against fields that are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from synthetic import frames_of, generator, uneven_field

from holocal.errors import InputError
from holocal.estimate.blocks import block_edges, block_means
from holocal.estimate.brightness import fit_brightness, weights_for
from holocal.estimate.thesis_map import BLOCK_PX, SIGMA_PX, WINDOW_PX, at_size, thesis_map

SIZE, BLOCK = 750, 33  # the thesis's capture; its blocks of 100 of 2300 pixels are 33 of 750
FIELD = uneven_field(SIZE, SIZE)
EVERYWHERE = np.ones((SIZE, SIZE), bool)
NO_WEIGHTS = np.zeros((1, 23, 23))


def left(estimate, truth, valid):
    """The non-uniformity that is left when a picture of brightness `truth` is divided by `estimate`."""
    ratio = (estimate / truth)[valid]
    return float(ratio.std() / ratio.mean())


@pytest.fixture(scope="module")
def four_frames():
    return frames_of(FIELD, seed=1, count=4)


@pytest.fixture(scope="module")
def fitted(four_frames):
    blocks = block_means(four_frames, BLOCK)
    return fit_brightness(blocks, np.repeat(NO_WEIGHTS, 4, axis=0), shown=EVERYWHERE, block_px=BLOCK, floor=0.2)[0]


def test_block_means_are_the_plain_means_of_an_oblong_picture():
    picture = generator(2).uniform(size=(2, 100, 67))
    found = block_means(picture, 20)
    rows, columns = block_edges(100, 20), block_edges(67, 20)
    assert (len(rows), len(columns)) == (6, 4)
    for i in range(5):
        for j in range(3):
            part = picture[:, rows[i] : rows[i + 1], columns[j] : columns[j + 1]]
            np.testing.assert_allclose(found.mean[:, i, j], part.mean(axis=(1, 2)), rtol=1e-12)  # float64 sums
    np.testing.assert_array_equal(found.centre_rows, [9.5, 29.5, 49.5, 69.5, 89.5])


@pytest.mark.parametrize(("contrast", "grain_px"), [(0.45, 0.0), (0.45, 1.0), (0.8, 2.0)])
def test_the_noise_read_off_a_block_is_the_scatter_of_its_means_from_frame_to_frame(contrast, grain_px):
    field = uneven_field(495, 495)
    found = block_means(frames_of(field, seed=3, count=12, contrast=contrast, grain_px=grain_px), BLOCK)
    scatter = np.var(found.mean / found.mean.mean(axis=0), axis=0, ddof=1)
    # 225 blocks of 11 degrees of freedom know the scatter to 3 %; neighbouring parts share grains, which the parts'
    # scatter cannot see: some 10 % at 2-pixel grains in parts of 11 pixels.
    assert found.relative_variance.mean() == pytest.approx(scatter.mean(), rel=0.25)


def test_the_thesis_map_is_the_literal_pipeline_in_opencv():
    picture = frames_of(FIELD, seed=4, count=1)[0]
    large = cv2.resize(picture.astype(np.float32), (WINDOW_PX, WINDOW_PX), interpolation=cv2.INTER_LINEAR)
    count = WINDOW_PX // BLOCK_PX
    means = large.reshape(count, BLOCK_PX, count, BLOCK_PX).mean(axis=(1, 3))
    squares = np.kron(means, np.ones((BLOCK_PX, BLOCK_PX), np.float32))
    literal = cv2.GaussianBlur(squares, (801, 801), SIGMA_PX, borderType=cv2.BORDER_REPLICATE)
    found = thesis_map(picture)
    assert found.shape == (WINDOW_PX, WINDOW_PX)
    # OpenCV's kernel is cut at 4 sigma (6e-5 of it) and takes the Gaussian at pixel centres in float32
    np.testing.assert_allclose(found, literal, rtol=2e-3)


def test_the_thesis_map_of_an_even_picture_is_even_up_to_the_border():
    np.testing.assert_allclose(thesis_map(np.full((SIZE, SIZE), 7.0)), 7.0, rtol=1e-6)  # the picture is float32


def test_four_frames_give_a_skewed_four_to_one_field_to_nine_per_mille(fitted):
    assert fitted.valid.mean() > 0.7
    assert left(fitted.brightness, FIELD, fitted.valid) <= 0.009  # what a prototype reached (issue 2)


def test_the_thesis_map_of_the_same_frames_leaves_more(four_frames, fitted):
    thesis = at_size(thesis_map(four_frames.mean(axis=0)), SIZE, SIZE)
    single = at_size(thesis_map(four_frames[0]), SIZE, SIZE)
    ours = left(fitted.brightness, FIELD, fitted.valid)
    assert left(thesis, FIELD, fitted.valid) > 1.3 * ours
    assert left(single, FIELD, fitted.valid) > 1.3 * ours


@pytest.mark.parametrize("seed", [5, 6])
def test_sigma_is_what_the_map_is_wrong_by(seed):
    blocks = block_means(frames_of(FIELD, seed=seed, count=2), BLOCK)
    found, _ = fit_brightness(blocks, np.repeat(NO_WEIGHTS, 2, axis=0), shown=EVERYWHERE, block_px=BLOCK, floor=0.2)
    error = np.log(found.brightness / FIELD)
    error -= error[found.valid].mean()  # what all places share is not known
    pull = float(np.sqrt(np.mean((error / found.sigma)[found.valid] ** 2)))
    assert 0.5 < pull < 2  # a smooth map has some 20 independent places: the pull itself scatters by 15 to 30 %


@pytest.mark.parametrize("gamma", [0.85, 1.0])
def test_the_exponent_of_the_response_is_found_from_frames_with_unlike_weights(gamma):
    dimmed = 0.25 / FIELD
    seen = [np.ones_like(FIELD), np.ones_like(FIELD), dimmed, dimmed]
    pictures = np.concatenate([frames_of(FIELD * w**gamma, seed=7 + i, count=1) for i, w in enumerate(seen)])
    pictures *= np.array([1.0, 1.0, 1.9, 1.9])[:, None, None]  # a panel sends elsewhere the light that is not wanted
    log_weights = np.log(block_means(np.stack(seen), BLOCK).mean)
    found, _ = fit_brightness(block_means(pictures, BLOCK), log_weights, shown=EVERYWHERE, block_px=BLOCK, floor=0.2)
    assert abs(found.gamma - gamma) < 3 * found.gamma_sigma
    assert found.gamma_sigma < 0.03  # weights from 1/4 to 1 against 1 % of noise per block know it well
    assert left(found.brightness, FIELD, found.valid) <= 0.012  # the exponent takes a share of the four frames


def test_an_all_dark_picture_is_refused():
    dark = block_means(np.zeros((2, 300, 300)), 30)
    with pytest.raises(InputError, match="no light") as caught:
        fit_brightness(dark, np.zeros((2, 10, 10)), shown=np.ones((300, 300), bool), block_px=30, floor=0.25)
    assert caught.value.code == "no-light"


def test_twenty_hot_pixels_hardly_change_the_map(four_frames, fitted):
    hot = four_frames.copy()
    places = generator(8).integers(0, SIZE, (20, 2))
    hot[:, places[:, 0], places[:, 1]] = 4095.0  # full scale, ten times the brightest mean
    blocks = block_means(hot, BLOCK)
    found, _ = fit_brightness(blocks, np.repeat(NO_WEIGHTS, 4, axis=0), shown=EVERYWHERE, block_px=BLOCK, floor=0.2)
    both = found.valid & fitted.valid
    change = np.log(found.brightness / fitted.brightness)[both]
    assert float(change.std()) < 0.01


def test_the_weights_even_out_the_valid_field_and_are_never_above_one(fitted):
    weights = weights_for(fitted, 0.2)
    assert weights.min() > 0 and weights.max() <= 1
    shown = (fitted.brightness * weights**fitted.gamma)[fitted.valid]
    np.testing.assert_allclose(shown, shown[0], rtol=1e-6)  # algebra in float64
    assert shown[0] == pytest.approx(fitted.brightness[fitted.valid].min(), rel=1e-6)
