"""Where things go: blazes, points and images, by the ray trace and by sums that know nothing of the engine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holocal.hologram.pipeline import HologramSettings, render_image
from holocal.hologram.settings import Zones
from holocal.optics.bench import Bench, Panel, field_directions
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.raytrace import connect, trace_to_pupil, trace_to_slm

DEG = np.pi / 180
PANEL = Panel(72, 60, 6e-6)
SETTINGS = HologramSettings(PANEL, Bench(), 515e-9, (8 * DEG, 8 * DEG), method=Zones(3))
SLM = np.stack(np.meshgrid(PANEL.x_m, PANEL.y_m), axis=-1)


def phases(tangents):
    """Return phi_p on the panel, (n, rows, columns)."""
    points = VirtualPoints.at(np.asarray(tangents)[:, None, None, :])
    return exact_phase(Bench(), points, SLM, wavelength_m=515e-9, steps=4).phase_rad


def brightest(u, tangents):
    """Return the tangents of the brightest of E(p) = sum_x u conj(exp(i phi_p))."""
    seen = np.abs(np.sum(u * np.exp(-1j * phases(tangents)), axis=(1, 2)))
    return tangents[int(np.argmax(seen))]


LINE = np.tan(np.linspace(-4, 4, 17) * DEG)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_blaze_moves_the_spot_by_the_ray_trace(axis, sign):
    # The panel shows the phase of the point straight ahead, plus a blaze. The ray leaving its centre with the added
    # sideways component lambda f arrives from a direction that the trace from panel to pupil gives.
    frequency = sign * 1e4 * np.eye(2)[axis]  # cycles per metre
    blaze = 2 * np.pi * (SLM @ frequency)
    u = np.exp(1j * (phases([(0.0, 0.0)])[0] + blaze))
    leaving = connect(Bench(), np.zeros(2), np.zeros(2)).slm_direction.copy()
    leaving[:2] += 515e-9 * frequency
    leaving[2] = np.sqrt(1 - np.sum(leaving[:2] ** 2))
    # the light of the panel's centre crosses the pupil elsewhere; from a point at infinity every crossing counts
    arriving = -trace_to_pupil(Bench(), np.zeros(2), leaving).direction
    wanted = arriving[:2] / arriving[2]
    candidates = np.stack([wanted * s for s in np.linspace(-1.5, 1.5, 25)])
    found = brightest(u, candidates)
    assert np.allclose(found, wanted, atol=0.15 * np.abs(wanted).max())


@pytest.mark.parametrize("axis", [0, 1])
def test_blaze_to_plus_x_moves_the_spot_to_plus_x_and_to_plus_y_to_plus_y(axis):
    # The eye sees the light come from +x_E when the panel's phase rises towards +x_S.
    line = LINE[:, None] * np.eye(2)[axis]
    start = phases([(0.0, 0.0)])[0]
    spots = [brightest(np.exp(1j * (start + 2 * np.pi * s * 1e4 * SLM[..., axis])), line)[axis] for s in (-1, 0, 1)]
    assert spots[1] == pytest.approx(0, abs=1e-9)
    assert spots[0] < -0.01
    assert spots[2] > 0.01


@pytest.mark.parametrize(("row", "column"), [(1, 7), (7, 6), (2, 2), (6, 0)])
def test_a_bright_pixel_is_seen_at_its_place_right_is_plus_x_and_top_is_plus_y(row, column):
    image = np.zeros((9, 9))
    image[row, column] = 1
    levels = render_image(image, SETTINGS, seed=1).levels.astype(float)
    _, fy = PANEL.illumination_frequency_per_m
    u = np.exp(1j * (levels * 2 * np.pi / 256 + 2 * np.pi * fy * PANEL.y_m[:, None]))
    centres = (np.arange(9) - 4) / 4.5 * np.tan(4 * DEG)
    candidates = [(x, y) for y in centres[::-1] for x in centres]
    assert brightest(u, candidates) == (centres[column], centres[8 - row])


def test_the_traced_ray_of_a_point_lands_where_its_footprint_is():
    # Newton's search goes from the panel to the pupil; the trace went the other way.
    tangent = np.array([0.04, -0.03])
    pupil = np.array([2e-4, -1e-4])
    landing = trace_to_slm(Bench(), Bench().pupil_points(pupil), field_directions(tangent)).landing_m
    found = exact_phase(Bench(), VirtualPoints.at(tangent), landing, wavelength_m=515e-9)
    assert np.allclose(found.pupil_m, pupil, atol=1e-12)


def test_nearer_points_need_light_that_diverges_more():
    # At a pupil point q the wave of a point at depth D has k |q|^2 / 2 D more phase than infinity's.
    slm = np.array([[1.5e-3, 0.0], [0.0, 1.5e-3]])
    near, endless = (
        exact_phase(Bench(), VirtualPoints.at(np.zeros(2), d), slm, wavelength_m=515e-9) for d in (0.5, np.inf)
    )
    path = near.phase_rad - endless.phase_rad
    q = np.sum(endless.pupil_m**2, axis=-1)
    assert np.all(path > 0)
    assert np.allclose(path, 2 * np.pi / 515e-9 * q / 2 / 0.5, rtol=0.05)  # first order in relief / depth = 0.024


def test_the_frame_of_a_mirrored_image_is_not_the_mirrored_frame():
    # The bench bends the light sideways in x: left and right are not alike, up and down are.
    image = np.zeros((9, 9))
    image[3, 6] = 1
    settings = replace(SETTINGS, iterations=0)
    straight, flipped = (render_image(i, settings, seed=1).levels for i in (image, image[::-1]))
    up = np.angle(np.exp(2j * np.pi / 256 * (straight.astype(float) - flipped[::-1])))
    # equal up to the initial phase, half a turn of the linear term, and rounding to levels
    assert np.std(np.angle(np.exp(1j * (up - up[30, 36])))) < 0.1
