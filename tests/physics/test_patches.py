"""The warped patches of the panel against exact phase functions."""

from dataclasses import replace

import numpy as np
import pytest

from holocal.hologram.pipeline import HologramSettings, render_image
from holocal.hologram.scenes.image import ZeroPhase
from holocal.hologram.zones import zone_plan
from holocal.optics.bench import Bench, Panel, Pose
from holocal.optics.phase_function import VirtualPoints, exact_phase

DEG = np.pi / 180
FULL = HologramSettings(Panel(3840, 2160, 3.74e-6), Bench(), 515e-9, (25 * DEG, 25 * DEG))
MISALIGNED = Bench(mirror=Pose((0.3 * DEG, -0.2 * DEG, 0.3 * DEG), (3e-4, -2e-4, 3e-4)))


def at(series, points):
    in_y, in_x = series.bases(points[:, 0], points[:, 1])
    return np.einsum("ni,ij...,nj->n...", in_y, series.coefficients, in_x)


@pytest.mark.parametrize(
    "settings",
    [
        FULL,
        replace(FULL, wavelength_m=473e-9, depth_m=0.25),
        replace(FULL, bench=MISALIGNED, gaze_rad=(0.1, 0.05)),
    ],
    ids=["nominal", "blue at 25 cm", "misaligned, gaze aside"],
)
def test_patches_leave_a_twentieth_of_a_radian_of_every_points_phase(settings):
    plan = zone_plan(settings)
    assert len(plan.zones) == 8
    rng = np.random.default_rng(0)
    squares = []
    for patch in plan.zones:
        (left, low), (right, high) = patch.rim_m.min(axis=0), patch.rim_m.max(axis=0)
        slm = rng.uniform((left, low), (right, high), (200, 2))
        tangents = rng.uniform(*np.array(patch.bounds).T, (40, 2))
        points = VirtualPoints.at(tangents[:, None], settings.depth_m)
        exact = exact_phase(settings.bench, points, slm, wavelength_m=settings.wavelength_m, gaze_rad=settings.gaze_rad)
        seen = np.linalg.norm(exact.pupil_m, axis=-1) <= settings.bench.pupil_diameter_m / 2
        common = at(patch.factor_turns, slm) + at(plan.reference_turns, slm)
        field = at(patch.shift, tangents)
        found = 2 * np.pi * (common + field[:, 2:] + field[:, :2] @ at(patch.warp, slm).T)
        squares.append((found - exact.phase_rad)[seen] ** 2)
    # nothing removed: piston and tilt count too. 0.05 rad at 515 nm; 10 % more in the blue
    assert np.sqrt(np.mean(np.concatenate(squares))) < 0.07


def test_patches_meet_without_a_seam():
    settings = replace(FULL, panel=Panel(2000, 400, 3.74e-6), fov_rad=(4 * DEG, 3 * DEG), iterations=0)
    image = np.zeros((9, 9))
    image[4, 4] = 1.0
    field = render_image(image, settings, seed=0, keep_complex=True, initial_phase=ZeroPhase()).field
    assert len(zone_plan(settings).zones) == 3
    middle = field[180:220]
    across = np.angle(middle[:, 1:] * np.conj(middle[:, :-1]))
    # a point's phase is smooth across the patches' borders: its second difference stays that of the smooth wave
    inner = across[:, 100:-100]  # the ends of the panel ring, as the ends of any band-limited field do
    assert np.abs(np.angle(np.exp(1j * np.diff(inner, axis=1)))).max() < 0.15


def test_pixels_that_see_nothing_of_the_field_are_left_out_and_named():
    settings = replace(FULL, fov_rad=(2 * DEG, 2 * DEG), gaze_rad=(0.0, 0.0), bench=Bench(pupil_diameter_m=0.2e-3))
    plan = zone_plan(settings)
    assert plan.missing
    assert len(plan.left_out()) == len(plan.missing)
    assert all("patch row" in sentence for sentence in plan.left_out())
