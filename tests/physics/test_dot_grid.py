"""Grids of dots: found, indexed and mapped against a known truth; and pictures that show none, refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from dot_pictures import Seen, Target, bar, picture, spots
from scipy.spatial import cKDTree

from holocal.errors import RefusedError
from holocal.estimate.dot_detection import find_dots
from holocal.estimate.dot_fit import Shapes, fit_discs
from holocal.estimate.dot_grid import DotGrid, detect_grid
from holocal.estimate.dot_indexing import index_dots
from holocal.estimate.map_fit import local_residual_px

PLAIN = Target(width=640, height=480)
BARREL, PINCUSHION = -0.2, 0.2


def matched(seen: Seen, grid: DotGrid, tolerance: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of each indexed dot from the true dot of its cell, and how many shown dots have a cell.

    The two lattices are laid over each other by the offset that most dots have; a dot in a wrong cell is far off.
    """
    places, spacing = cKDTree(seen.centre), np.median(cKDTree(seen.centre).query(seen.centre, k=2)[0][:, 1])
    near, index = places.query(grid.centre_px)
    on = near < tolerance * spacing
    offset = np.column_stack([seen.row[index] - grid.row, seen.column[index] - grid.column])[on]
    values, counts = np.unique(offset, axis=0, return_counts=True)
    row, column = values[counts.argmax()]
    true = {(r, c): at for r, c, at in zip(seen.row, seen.column, seen.centre, strict=True)}
    keys = [(r + row, c + column) for r, c in zip(grid.row, grid.column, strict=True)]
    distance = [np.linalg.norm(grid.centre_px[i] - true[key]) for i, key in enumerate(keys) if key in true]
    shown = {(r, c) for r, c, s in zip(seen.row, seen.column, seen.shown, strict=True) if s}
    return np.array(distance), np.array(len(shown & set(keys)) / len(shown))


CASES = {
    "plain": PLAIN,
    "barrel": PLAIN.but(k1=BARREL, spacing=26),
    "pincushion": PLAIN.but(k1=PINCUSHION),
    "rotated by 40 degrees": PLAIN.but(rotation=40),
    "perspective": PLAIN.but(perspective=(0.2, 0.15), rotation=-20),
    "bright on dark": PLAIN.but(dark=False, contrast=0.9, k1=0.1, rotation=10),
    "a fifth missing": PLAIN.but(missing=0.2, k1=-0.1, rotation=15, seed=4),
    "a dark quadrant": PLAIN.but(dark_quadrant=0.1, missing=0.1, seed=5),
    "stained and vignetted": PLAIN.but(stains=8, vignetting=0.6, seed=6),
    "oblong cells": PLAIN.but(aspect=1.35, rotation=8),
    "small dots": PLAIN.but(width=400, height=300, spacing=9, radius=2.2),
    "large dots": PLAIN.but(spacing=70, radius=20, k1=-0.1),
    "fat dots": PLAIN.but(radius=9),
    "thin dots": PLAIN.but(spacing=50, radius=4.5),
    "strong perspective": PLAIN.but(perspective=(0.45, 0.2), spacing=26, radius=6.5),
    "dots of different sizes": PLAIN.but(sizes=0.18, seed=2),
    "a marker of larger dots": PLAIN.but(marked=((0, 0), (1, 0), (0, 2)), rotation=5),
    "a ruler across": PLAIN.but(ruler=2.5, spacing=20, radius=5, rotation=3, k1=-0.1),
}


@pytest.mark.parametrize("target", CASES.values(), ids=CASES.keys())
def test_every_dot_gets_its_cell_and_its_place(target):
    seen = picture(target)
    grid = detect_grid(seen.image)
    distance, share = matched(seen, grid)
    assert distance.max() < 0.3 * target.spacing  # a wrong row or column is a whole spacing off
    assert share > 0.97  # dots that stains or missing neighbours hide are few
    # 0.01 of noise on a step of 0.6 gives 0.008 px per coordinate; the dark quadrant has ten times less light
    good = distance[grid.sigma_px[: len(distance)] < 0.05] if target.dark_quadrant < 1 else distance
    assert np.sqrt(np.mean(np.minimum(good, 1) ** 2) / 2) < 0.035
    assert np.median(distance) < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_sigmas_are_as_large_as_the_errors(seed):
    seen = picture(PLAIN.but(noise=0.03, rotation=9, seed=seed))
    grid = detect_grid(seen.image)
    _, index = cKDTree(seen.centre).query(grid.centre_px)
    z = (grid.centre_px - seen.centre[index]) / grid.sigma_px[:, None]
    assert 0.85 < np.sqrt(np.mean(z[np.abs(z).max(axis=1) < 5] ** 2)) < 1.2  # 400 dots: 3 % by chance


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.02])
def test_centres_are_good_to_two_hundredths_of_a_pixel(noise):
    seen = picture(PLAIN.but(noise=noise, spacing=22.7, radius=5.3, rotation=3))
    dots = find_dots(seen.image)
    distance, _ = cKDTree(dots.centre_px).query(seen.centre)
    assert len(dots) >= len(seen.centre)
    assert np.sqrt(np.mean(distance**2) / 2) < 0.02
    assert distance.max() < 0.1


def test_a_neighbour_that_is_missing_does_not_pull_a_dot():
    seen = picture(PLAIN.but(noise=0.0, missing=0.4, spacing=15, radius=4.5))
    dots = find_dots(seen.image)
    distance, _ = cKDTree(dots.centre_px).query(seen.centre[seen.shown])
    assert np.quantile(distance, 0.99) < 0.02


def test_a_sloping_ground_does_not_pull_a_dark_dot():
    y, x = np.mgrid[:41, :41].astype(float)
    light = 1 + 0.03 * (x - 20)
    disc = 1 / (1 + np.exp(2 * (np.hypot(x - 20.3, y - 19.6) - 6)))
    image = (light * (1 - 0.9 * disc) + 0.1).astype(np.float32)  # haze over all
    shapes = Shapes(np.array([6.5]), np.zeros((1, 2)), np.array([8.0]))
    fit = fit_discs(
        image, np.array([[20.0, 20.0]]), shapes=shapes, window_px=np.array([11.0]), opacity=0.9, iterations=6
    )
    assert np.abs(fit.centre_px[0] - [20.3, 19.6]).max() < 0.01
    assert fit.shapes.radius_px[0] == pytest.approx(6, abs=0.15)


def test_dots_that_the_edge_cuts_off_are_left_out():
    seen = picture(PLAIN.but(rotation=5))
    grid = detect_grid(seen.image)
    low, high = grid.centre_px.min(axis=0), grid.centre_px.max(axis=0)
    assert low.min() > PLAIN.radius - 0.5
    assert (high < np.array([PLAIN.width, PLAIN.height]) - PLAIN.radius - 0.5).all()


def test_rows_run_down_and_columns_to_the_right():
    for rotation in (-40, -15, 0, 30):
        grid = detect_grid(picture(PLAIN.but(rotation=rotation)).image)
        slope = grid.smooth_map.jacobian(np.array([[grid.columns / 2, grid.rows / 2]]))[0]
        assert slope[0, 0] > 0.7 * PLAIN.spacing
        assert slope[1, 1] > 0.7 * PLAIN.spacing
        assert grid.row.min() == grid.column.min() == 0


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mirrored", [False, True])
def test_speckled_spots_with_ghosts_gaps_and_a_dark_quadrant_are_indexed(seed, mirrored):
    target = Target(
        width=800, height=700, spacing=30, missing=0.2, dark_quadrant=0.1, rotation=-12 + 30 * seed, k1=0.1, seed=seed
    )
    seen = spots(target)
    grid = detect_grid(seen.image[:, ::-1] if mirrored else seen.image)
    if mirrored:
        back = np.column_stack([target.width - 1 - seen.centre[:, 0], seen.centre[:, 1]])
        seen = Seen(seen.image, back, seen.row, -seen.column, seen.shown)
    distance, share = matched(seen, grid)
    # Grains as large as the spots: a spot's centroid is a pixel uncertain, whoever takes it.
    assert np.median(distance) < 1.5
    assert np.mean(distance > 0.3 * target.spacing) < 0.01  # ghosts beside the lattice, none of them a wrong row
    assert share > 0.9


@pytest.mark.parametrize("k1", [BARREL, 0.0, PINCUSHION])
def test_the_map_predicts_dots_it_has_not_seen_to_their_noise(k1):
    target = PLAIN.but(k1=k1, spacing=20, radius=5, perspective=(0.05, 0.03))
    grid = detect_grid(picture(target).image)
    found = grid.smooth_map
    lattice = np.column_stack([grid.column, grid.row]).astype(float)
    kept = ~found.outlier
    floor = np.sqrt(np.mean(local_residual_px(lattice, grid.centre_px)[kept] ** 2))
    assert found.holdout_rms_px < 1.3 * floor
    assert found.holdout_rms_px < 0.03


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((300, 400))


def clouds(seed: int) -> np.ndarray:
    """A picture with the spectrum of photographs."""
    frequency = np.hypot(np.fft.fftfreq(300)[:, None], np.fft.fftfreq(400)[None])
    frequency[0, 0] = 1
    image = np.fft.ifft2(np.fft.fft2(noise(seed)) / frequency).real
    return (image - image.min()) / np.ptp(image)


def face(seed: int) -> np.ndarray:
    """Two eyes, a nose and a mouth on an oval, in soft light."""
    image = np.full((300, 400), 0.2)
    for at, axes, value in (
        ((200, 150), (90, 120), 0.8),
        ((165, 120), (14, 8), 0.1),
        ((235, 120), (14, 8), 0.1),
        ((200, 160), (10, 18), 0.6),
        ((200, 210), (34, 8), 0.3),
    ):
        cv2.ellipse(image, at, axes, 0, 0, 360, value, -1)
    return cv2.GaussianBlur(image, (0, 0), 2.0) + 0.01 * np.random.default_rng(seed).normal(size=image.shape)


def confetti(seed: int) -> np.ndarray:
    """Discs like a target's, at random."""
    image = np.ones((300, 400))
    for x, y in np.random.default_rng(seed).uniform(0, [400, 300], (200, 2)):
        cv2.circle(image, (int(x), int(y)), 5, 0.2, -1)
    return cv2.GaussianBlur(image, (0, 0), 0.8)


NO_GRIDS = {
    "noise": noise,
    "smooth noise": lambda seed: cv2.GaussianBlur(noise(seed), (0, 0), 3.0),
    "clouds": clouds,
    "a face": face,
    "confetti": confetti,
    "a gradient": lambda seed: np.linspace(0, 1, 400)[None] * np.ones((300, 1)),
    "black": lambda seed: np.zeros((300, 400)),
    "one pixel": lambda seed: np.ones((1, 1)),
    "a strip": lambda seed: np.ones((3, 900)),
}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("make", NO_GRIDS.values(), ids=NO_GRIDS.keys())
def test_a_picture_without_a_grid_is_refused(make, seed):
    with pytest.raises(RefusedError, match="no grid of dots") as refused:
        detect_grid(np.clip(make(seed), 0, 1).astype(np.float32))
    assert refused.value.exit_status == 4
    assert refused.value.code == "no-grid"


def test_a_sharp_shadow_ends_no_lattice_of_bright_dots():
    target = PLAIN.but(dark=False, dark_quadrant=0.1, shadow=1.0, noise=0.005)
    seen = picture(target)
    off = np.abs(seen.centre + 0.5 - [target.width / 2, target.height / 2]).min(axis=1)
    seen.shown[off < target.radius + 2] = False  # the shadow's edge moves the dots that it cuts
    distance, share = matched(seen, detect_grid(seen.image))
    assert distance.max() < 0.3 * target.spacing
    assert share > 0.98


def test_larger_dots_of_a_marker_are_as_precise_as_others():
    target = PLAIN.but(marked=((0, 0), (1, 0), (0, 2)), rotation=5)
    seen = picture(target)
    grid = detect_grid(seen.image)
    for cell in target.marked:
        at = seen.centre[(seen.column == cell[0]) & (seen.row == cell[1])][0]
        assert np.linalg.norm(grid.centre_px - at, axis=1).min() < 0.05


def test_pieces_beside_a_ruler_that_do_not_fit_are_not_joined():
    target = PLAIN.but(ruler=2.5, spacing=20, radius=5)
    image = picture(target).image
    _, bottom = bar(target)
    torn = image.copy()
    torn[bottom:] = np.roll(image, 8, axis=1)[bottom:]  # by 0.4 of the spacing
    for whole, joined in ((image, True), (torn, False)):
        assert (detect_grid(whole).centre_px[:, 1].max() > bottom) == joined


def test_two_lattices_that_do_not_fit_are_not_joined():
    left = picture(PLAIN.but(seed=1)).image
    right = picture(PLAIN.but(seed=2)).image
    torn = left.copy()
    torn[:, 400:] = np.roll(right, 9, axis=0)[:, 400:]  # by 0.4 of the spacing
    grid = detect_grid(torn)
    assert (grid.centre_px[:, 0] < 410).all()
    index = index_dots(find_dots(torn))
    assert index.disagreement < 0.01
