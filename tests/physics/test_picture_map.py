"""An image through a map: what is to be seen in a place is sent from where that place is seen."""

import cv2
import numpy as np
import pytest

from holocal.errors import InputError
from holocal.estimate.map_fit import fit_smooth_map
from holocal.estimate.picture_map import FourCorners, as_remap, outermost, predistort

SHAPE = (200, 240)


def lens(points):
    """A bent, turned and shifted picture."""
    middle = np.array([SHAPE[1], SHAPE[0]]) / 2 - 0.5
    r = (points - middle) / 120
    bent = r * (1 + 0.05 * np.sum(r**2, axis=-1, keepdims=True)) @ np.array([[0.999, 0.03], [-0.03, 0.999]])
    return bent * 120 + middle + [6.0, -4.0]


def seen_over(shape, grid):
    rows, columns = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(grid, shape, strict=True))
    at = np.stack(np.meshgrid(columns, rows), axis=-1)
    return lens(at.reshape(-1, 2)).reshape(*at.shape)


def smooth_image():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 2.0 + np.sin(x / 9) + np.cos(y / 7) * np.sin(x / 15)


def test_a_predistorted_image_is_seen_straight():
    columns, rows = as_remap(seen_over(SHAPE, (40, 48)), SHAPE, SHAPE)
    sent = predistort(smooth_image(), columns, rows)
    # the eye sees at lens(p) what is sent at p: so the picture at q is what is sent at the inverse of q
    y, x = np.mgrid[40:160, 40:200]
    at = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    back = at.copy()
    for _ in range(50):
        back += at - lens(back)
    seen = cv2.remap(sent, *(back[:, k].astype(np.float32).reshape(120, 160) for k in (0, 1)), cv2.INTER_CUBIC)
    assert np.sqrt(np.mean((seen - smooth_image()[40:160, 40:200]) ** 2)) < 0.02  # cv2.remap reads in 1/32 pixels


def test_any_tool_that_remaps_does_the_same():
    columns, rows = as_remap(seen_over(SHAPE, (40, 48)), SHAPE, SHAPE)
    image = smooth_image().astype(np.float32)
    other = np.maximum(cv2.remap(image, columns, rows, cv2.INTER_CUBIC), 0)
    assert np.array_equal(predistort(image, columns, rows), other)


def test_the_enlarged_map_is_the_map():
    columns, rows = as_remap(seen_over(SHAPE, (40, 48)), SHAPE, SHAPE)
    exact = seen_over(SHAPE, SHAPE)
    off = np.maximum(np.abs(columns - exact[..., 0]), np.abs(rows - exact[..., 1]))
    assert off[5:-5, 5:-5].max() < 5e-3 and off.max() < 0.03  # the outermost cells' halves are extrapolated


def test_the_map_and_its_inverse_meet_to_a_hundredth_of_a_pixel():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (160, 2)) * [SHAPE[1], SHAPE[0]]
    found = fit_smooth_map(points, lens(points) + 0.03 * rng.normal(size=points.shape))
    y, x = np.mgrid[: SHAPE[0] : 10, : SHAPE[1] : 10]
    at = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    back, sure = found.inverse(at)
    assert sure.all() and np.abs(found(back) - at).max() < 0.01


def test_four_corners_leave_the_middle_of_a_bent_picture_off():
    y, x = np.mgrid[5:200:10, 5:240:10]
    points = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    known = np.ones(len(points), bool)
    known[0] = False
    four = outermost(points, known)
    assert 0 not in four and len(set(four.tolist())) == 4
    found = FourCorners.through(points[four], lens(points)[four])
    off = np.linalg.norm(found(points) - lens(points), axis=1)
    assert off[four].max() < 1e-3 and off.max() > 1.0
    assert np.abs(found.inverse(found(points))[0] - points).max() < 1e-6
    assert np.isnan(found.sigma_px(points)).all()


def test_maps_that_do_not_fit_are_refused():
    with pytest.raises(InputError):
        predistort(np.zeros((4, 4)), np.zeros((4, 4), np.float32), np.zeros((3, 4), np.float32))
