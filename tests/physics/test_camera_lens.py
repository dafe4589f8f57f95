"""The camera's own geometry: as the simulated rig's lens has it, and back."""

import numpy as np
import pytest

from holocal.estimate.camera_lens import ideal_pixels, ideal_tangents, seen_pixels, seen_tangents
from holocal.records.facts import CameraFacts
from rigs.simulated.camera import Lens

FIELD = np.radians(25.0)


def camera(width=750, height=600, **own):
    tall = 2 * np.arctan(np.tan(FIELD / 2) * height / width)
    return CameraFacts(width, height, (FIELD, tall), 4095, 1e-5, 1.0, **own)


@pytest.mark.parametrize(
    "own", [{}, {"rotation_rad": 0.3}, {"k1": -0.2}, {"rotation_rad": -1.2, "k1": 0.15, "k2": -0.3}]
)
def test_pixels_look_where_the_simulated_lens_has_them_look_and_back(own):
    facts = camera(**own)
    lens = Lens(facts.width, facts.height, FIELD, own.get("rotation_rad", 0.0), own.get("k1", 0.0), own.get("k2", 0.0))
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1, (200, 2)) * [749, 599]
    tangents = seen_tangents(pixels, facts)
    x, y = lens.tangents(pixels[:, 0], pixels[:, 1])
    assert np.abs(tangents - np.stack([x, y], axis=-1)).max() < 1e-9
    assert np.abs(seen_pixels(tangents, facts) - pixels).max() < 1e-6


def test_without_a_geometry_of_its_own_the_camera_is_the_ideal_one():
    facts = camera()
    tangents = np.array([[0.0, 0.0], [np.tan(FIELD / 2), 0.0], [0.0, 0.1]])
    assert np.allclose(seen_pixels(tangents, facts), ideal_pixels(tangents, facts))
    assert np.allclose(ideal_pixels(tangents, facts)[0], [374.5, 299.5])
    assert np.allclose(ideal_pixels(tangents, facts)[1], [749.5, 299.5])
    assert ideal_pixels(tangents, facts)[2, 1] < 299.5  # up is towards row 0
    assert np.allclose(ideal_tangents(ideal_pixels(tangents, facts), facts), tangents)
