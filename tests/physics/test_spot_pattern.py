"""A pattern of spots is recognised upright and in its own place, or refused: never mirrored, turned or a pitch off."""

import numpy as np
import pytest

from holocal.errors import RefusedError
from holocal.estimate.spot_pattern import ORIENTATIONS, recognise, require_recognised
from procedures._aberration_spots import zone_directions

SIZE = 300


def places_of(side, span):
    """Irregular places of side x side spots that span this share of the picture."""
    half = np.tan(np.radians(12.5))
    tangents = zone_directions(side, (np.radians(25.0),) * 2) / half
    return (tangents * [1, -1] * span / 2 + 0.5) * SIZE - 0.5


def picture_of(places, rng, *, missing=0.0, noise=0.05, sigma=2.0):
    """Spots of uneven light with ghosts, a zero order and noise."""
    y, x = np.mgrid[:SIZE, :SIZE]
    image = noise * rng.normal(size=(SIZE, SIZE))
    light = rng.uniform(0.3, 1.0, len(places)) * (rng.uniform(size=len(places)) >= missing)
    for (column, row), much in zip(places, light, strict=True):
        image += much * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * sigma**2))
        image += 0.05 * much * np.exp(-((x - SIZE + column) ** 2 + (y - SIZE + row) ** 2) / (2 * sigma**2))
    return image + 2.0 * np.exp(-((x - SIZE / 2) ** 2 + (y - SIZE / 2) ** 2) / (2 * sigma**2))


def seen(side, span, rng, shift=(0.0, 0.0), **how):
    places = places_of(side, span)
    c, s = np.cos(np.radians(rng.uniform(-1, 1))), np.sin(np.radians(rng.uniform(-1, 1)))
    middle = SIZE / 2 - 0.5
    turned = (places - middle) @ np.array([[c, -s], [s, c]]) * rng.uniform(0.99, 1.01) + middle + shift
    return places, picture_of(turned, rng, **how)


def found_in(picture, places):
    apart = SIZE / np.sqrt(len(places)) / 2
    return recognise(picture, places, np.ones(len(places)), sigma_px=2.0, apart_px=apart)


@pytest.mark.parametrize("seed", range(200))
def test_the_pattern_is_never_taken_for_itself_a_pitch_off(seed):
    rng = np.random.default_rng(seed)
    span, side = rng.uniform(0.3, 0.95), int(rng.integers(5, 10))
    shift = rng.uniform(-0.12, 0.12, 2) * SIZE
    places, picture = seen(side, span, rng, shift, missing=rng.uniform(0, 0.2))
    found = found_in(picture, places)
    right = np.hypot(*(found.shift_px - shift)) < 0.4 * span * SIZE / side and found.orientation == ORIENTATIONS[0]
    if not right:
        with pytest.raises(RefusedError):
            require_recognised(found)
    elif span * SIZE / side > 28:  # nearer ones lie off their lattice by less than a spot
        assert require_recognised(found) is found


@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_mirrored_or_turned_camera_is_refused_by_name(quarter, mirrored):
    rng = np.random.default_rng(5)
    places, picture = seen(8, 0.8, rng, (11.0, -7.0), missing=0.1)
    if mirrored:
        picture = picture[:, ::-1]
    found = found_in(np.rot90(picture, quarter), places)
    if not quarter and not mirrored:
        assert np.hypot(*(require_recognised(found).shift_px - [11.0, -7.0])) < 4
        return
    with pytest.raises(RefusedError) as refused:
        require_recognised(found)
    assert "upright" in str(refused.value)
    assert found.orientation != ORIENTATIONS[0]
    assert ("mirrored" in found.orientation) == mirrored


def test_a_picture_of_something_else_is_refused():
    rng = np.random.default_rng(1)
    with pytest.raises(RefusedError):
        require_recognised(found_in(rng.normal(size=(SIZE, SIZE)), places_of(8, 0.8)))
    with pytest.raises(RefusedError):
        require_recognised(found_in(np.zeros((SIZE, SIZE)), places_of(8, 0.8)))
