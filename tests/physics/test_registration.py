"""Where the camera sees the image's points: against shifts, turns, stretches and bends that are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from synthetic import generator, speckle

from holocal.errors import RefusedError
from holocal.estimate.registration import blob_image, blob_places, register
from procedures._uniformity_geometry import require_registered

SIZE = 750
MIDDLE = (SIZE - 1) / 2


class Bend:
    """A known map of image points to picture points: turned, stretched, bent like a barrel, shifted."""

    def __init__(self, shift=(0.0, 0.0), turn_deg=0.0, scale=1.0, barrel_px=0.0):
        self.shift, self.turn, self.scale, self.barrel = np.array(shift), np.radians(turn_deg), scale, barrel_px

    def to_picture(self, points):
        u = (points - MIDDLE) / MIDDLE
        # A quadratic, as an off-axis mirror bends a picture: `barrel` pixels at the edge.
        bent = np.stack([u[..., 0] ** 2 - 0.5 * u[..., 0] * u[..., 1], 0.7 * u[..., 1] ** 2], axis=-1)
        c, s = np.cos(self.turn), np.sin(self.turn)
        turned = u @ np.array([[c, s], [-s, c]])
        return MIDDLE + MIDDLE * self.scale * turned + self.barrel * bent + self.shift

    def to_image(self, points):
        found = points - self.shift
        for _ in range(30):  # a bend of some per cent: each pass gains more than an order
            found = found + (points - self.to_picture(found))
        return found


def grid():
    return np.stack(np.meshgrid(np.arange(0, SIZE, 15.0), np.arange(0, SIZE, 15.0)), axis=-1)


def picture_of(bend, lit, seed=1, contrast=0.45):
    """What a camera sees of the blobs: bent, dimmed by `lit`, with speckle, noise and the dark subtracted."""
    at = bend.to_image(np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).astype(float))
    at = at.astype(np.float32)
    seen = cv2.remap(blob_image(SIZE, SIZE).astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    rng = generator(seed)
    grains = speckle(rng, SIZE, SIZE, contrast=contrast, grain_px=1.0)
    return 800.0 * seen * lit * grains + rng.normal(0, 2.0, seen.shape)


def half_dark():
    """Vignetting that leaves the left half of the field all but dark."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE))
    return np.exp(-0.5 * y**2) / (1 + np.exp(-(x + 0.05) / 0.04))


def between_lit_blobs(bend, lit, picture):
    """Where a polynomial through the blobs interpolates: beyond them nothing is known, and errors grow to 1.3 px."""
    seen = bend.to_picture(blob_places(SIZE, SIZE))
    seen = seen[np.all((seen > 20) & (seen < SIZE - 20), axis=-1)]
    seen = seen[lit[seen[:, 1].astype(int), seen[:, 0].astype(int)] > 0.3]
    hull = cv2.convexHull(seen.astype(np.float32))
    flat = picture.reshape(-1, 2)
    return np.array([cv2.pointPolygonTest(hull, (float(x), float(y)), False) > 0 for x, y in flat]).reshape(
        picture.shape[:-1]
    )


BENDS = {
    "shifted by 35 pixels": Bend(shift=(35.0, -12.3)),
    "turned by a degree": Bend(turn_deg=1.0),
    "three per cent smaller": Bend(scale=0.97),
    "bent by five pixels": Bend(barrel_px=5.0),
    "all of it": Bend(shift=(-35.0, 14.2), turn_deg=-1.0, scale=1.03, barrel_px=4.0),
}


@pytest.mark.parametrize("bend", BENDS.values(), ids=BENDS.keys())
def test_points_between_lit_blobs_are_mapped_to_a_pixel_both_ways(bend):
    lit = half_dark()
    found = register(picture_of(bend, lit))
    assert found.found >= 25 and found.shown == 81
    assert found.residual_px < 1.0
    picture = grid()
    image = bend.to_image(picture)
    inside = between_lit_blobs(bend, lit, picture)
    assert inside.mean() > 0.3
    back = np.stack(found.picture_to_image(picture[..., 0], picture[..., 1]), axis=-1)
    there = np.stack(found.image_to_picture(image[..., 0], image[..., 1]), axis=-1)
    for error in (np.linalg.norm(back - image, axis=-1)[inside], np.linalg.norm(there - picture, axis=-1)[inside]):
        # A centroid of a 6-pixel blob under speckle is good to 0.5 px; some 35 blobs fix 12 coefficients.
        assert np.sqrt(np.mean(error**2)) < 0.6
        assert np.quantile(error, 0.97) < 1.0
        assert error.max() < 1.5  # at the outermost blobs, where the quadratic hangs on one or two of them: 1.2 seen
    again = np.stack(found.image_to_picture(back[..., 0], back[..., 1]), axis=-1)
    assert np.linalg.norm(again - picture, axis=-1)[inside].max() < 0.3  # two fits of the same blobs


def test_the_shift_of_the_middle_is_reported():
    found = register(picture_of(Bend(shift=(35.0, -12.3)), np.ones((SIZE, SIZE))))
    assert found.found > 60
    assert found.shift_px == pytest.approx((35.0, -12.3), abs=0.5)


def test_a_picture_of_nothing_is_not_registered():
    found = register(np.zeros((SIZE, SIZE)))
    assert found.found == 0 and found.shift_px == (0.0, 0.0)
    for mapped in (found.image_to_picture(np.array([3.0]), np.array([5.0])), found.picture_to_image(3.0, 5.0)):
        assert (float(np.squeeze(mapped[0])), float(np.squeeze(mapped[1]))) == (3.0, 5.0)


def test_noise_alone_is_not_registered_well():
    found = register(generator(3).normal(0, 2.0, (SIZE, SIZE)))
    assert found.found < 41  # fewer than half of the blobs: not to be believed


def test_a_mirrored_picture_does_not_register():
    found = register(picture_of(Bend(), np.ones((SIZE, SIZE)))[:, ::-1].copy())
    assert found.found < 41  # fewer than half of the blobs: not to be believed


def test_the_blobs_lie_inside_the_image_and_never_touch():
    places = blob_places(SIZE, SIZE)
    assert places.min() > 0 and places.max() < SIZE - 1
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 1e3 * np.eye(len(places))
    assert apart.min() > 2 * 3 * 0.008 * SIZE * 0.8  # windows of three sigma overlap by a fifth at most


@pytest.mark.parametrize("turn", [np.fliplr, np.flipud, np.rot90], ids=["mirrored", "upside down", "turned"])
def test_a_mirrored_or_turned_camera_is_refused_with_its_numbers(turn):
    picture = turn(blob_image(300, 300)).copy()
    with pytest.raises(RefusedError, match="blobs were found") as caught:
        require_registered(register(picture))
    assert caught.value.exit_status == 4
    assert require_registered(register(blob_image(300, 300))).residual_px < 0.1
