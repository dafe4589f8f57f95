"""From image to levels: points, seeds, bad input, and what the frame sends into the pupil by an independent sum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holocal.errors import InputError, UsageError
from holocal.hologram.encode.ifta_encoder import Ifta
from holocal.hologram.pipeline import HologramSettings, render, render_image
from holocal.hologram.scenes.image import RandomPhase, ZeroPhase, image_cloud
from holocal.hologram.settings import Warped, Zones
from holocal.optics.bench import Bench, Panel, image_tangents
from holocal.optics.phase_function import VirtualPoints, exact_phase

DEG = np.pi / 180
SETTINGS = HologramSettings(Panel(120, 90, 5e-6), Bench(), 515e-9, (10 * DEG, 8 * DEG))


def seen(rendered, settings, tangents):
    """Return the field the eye sees at tangents, exactly: sum_x u conj(A_p exp(i phi_p)) (docs/physics.md 6)."""
    panel = settings.panel
    slm = np.stack(np.meshgrid(panel.x_m, panel.y_m), axis=-1)
    fx, fy = panel.illumination_frequency_per_m
    light = 2 * np.pi * (fx * panel.x_m[None, :] + fy * panel.y_m[:, None])
    u = np.exp(1j * (2 * np.pi / 256 * rendered.levels.astype(float) + light))
    out = []
    for tangent in tangents:
        found = exact_phase(
            settings.bench,
            VirtualPoints.at(tangent, settings.depth_m),
            slm,
            wavelength_m=settings.wavelength_m,
            gaze_rad=settings.gaze_rad,
        )
        inside = np.linalg.norm(found.pupil_m, axis=-1) <= settings.bench.pupil_diameter_m / 2
        out.append(np.sum(u * inside * np.exp(-1j * found.phase_rad)) / u.size)
    return np.array(out)


@pytest.mark.parametrize(
    "settings",
    [
        SETTINGS,
        replace(SETTINGS, gaze_rad=(-0.05, 0.08)),
        replace(SETTINGS, depth_m=0.4, wavelength_m=473e-9, method=Zones(2)),
    ],
    ids=["nominal", "gaze", "0.4 m, blue, 2 x 2 zones"],
)
def test_three_bright_points_are_seen_where_they_are_and_as_bright_as_asked(settings):
    image = np.zeros((33, 41))
    spots = {(6, 33): 1.0, (20, 8): 1.0, (27, 22): 4.0}
    for place, intensity in spots.items():
        image[place] = intensity
    rendered = render_image(image, settings, seed=1)
    x, y = image_tangents(41, 33, settings.fov_rad)
    field = seen(rendered, settings, [(x[c], y[r]) for r, c in spots])
    share = np.abs(field) ** 2
    assert share.sum() == pytest.approx(rendered.efficiency, rel=0.05)  # 8-bit levels and zones cost a few percent
    assert np.allclose(share / share.sum(), np.array(list(spots.values())) / 6, atol=0.03)
    # six image pixels beside: 1.5 degrees, 3.8 grains of this 0.6 mm panel away
    beside = np.abs(seen(rendered, settings, [(x[c - 6], y[r]) for r, c in spots])) ** 2
    assert beside.max() < 0.1 * share.min()


def test_the_full_complex_hologram_is_the_sum_of_the_points_waves():
    image = np.zeros((9, 9))
    image[2, 6], image[5, 1] = 1.0, 4.0
    settings = replace(SETTINGS, method=Zones(7))
    rendered = render_image(image, settings, seed=2, keep_complex=True)
    phase = RandomPhase(2)(*image_tangents(9, 9, settings.fov_rad))
    x, y = image_tangents(9, 9, settings.fov_rad)
    slm = np.stack(np.meshgrid(settings.panel.x_m, settings.panel.y_m), axis=-1)
    wanted = 0
    for (r, c), amplitude in {(2, 6): 1.0, (5, 1): 2.0}.items():
        point = VirtualPoints.at(np.array([x[c], y[r]]))
        found = exact_phase(settings.bench, point, slm, wavelength_m=settings.wavelength_m)
        wanted = wanted + amplitude * np.exp(1j * (found.phase_rad + phase[r, c]))
    assert rendered.field.dtype == np.complex64
    # zones share a wavefront within 0.1 rad here, and the table knows a point's piston within 0.25 turns; the grid is
    # coarser than the panel, which rings at the panel's edges
    inner = (slice(10, -10), slice(10, -10))
    assert np.linalg.norm((rendered.field - wanted)[inner]) < 0.2 * np.linalg.norm(wanted[inner])


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    image = np.random.default_rng(0).random((40, 50))
    one, again, other = (render_image(image, SETTINGS, seed=s) for s in (4, 4, 5))
    assert one.levels.tobytes() == again.levels.tobytes()
    assert one.phase_rad.tobytes() == again.phase_rad.tobytes()
    assert np.mean(one.levels != other.levels) > 0.9


@pytest.mark.parametrize("method", [Warped(), Zones()], ids=["patches", "zones"])
@pytest.mark.parametrize("size", [(64, 48), (97, 61), (960, 540)])
def test_a_panel_of_any_size_gets_its_frame(size, method):
    settings = replace(SETTINGS, panel=Panel(*size, 3.74e-6), fov_rad=(25 * DEG, 25 * DEG), method=method)
    rendered = render_image(np.ones((75, 75)), settings, seed=0)
    assert rendered.levels.shape == rendered.phase_rad.shape == (size[1], size[0])
    assert rendered.levels.dtype == np.uint8
    assert rendered.phase_rad.dtype == np.float32
    assert rendered.phase_rad.min() >= 0
    assert rendered.phase_rad.max() < np.float32(2 * np.pi)
    assert rendered.field is None
    assert 0.4 < rendered.efficiency < 1
    assert np.all(np.diff(rendered.signal_error) < 0)
    assert any("misses the panel" in sentence for sentence in rendered.skipped) is isinstance(method, Zones)
    assert set(rendered.seconds) >= {"table", "synthesis", "encode", "levels"}


def test_a_black_image_is_a_uniform_frame():
    rendered = render_image(np.zeros((20, 20)), SETTINGS, seed=0, keep_complex=True)
    assert not rendered.levels.any()
    assert rendered.efficiency == 0
    assert not rendered.field.any()
    assert any("uniform" in sentence for sentence in rendered.skipped)


def test_an_image_of_one_pixel_is_a_point_at_the_centre():
    rendered = render_image(np.ones((1, 1)), SETTINGS, seed=0)
    assert np.abs(seen(rendered, SETTINGS, [(0.0, 0.0)])[0]) ** 2 > 0.95


def test_the_scale_of_the_image_does_not_matter():
    image = np.random.default_rng(1).random((12, 12))
    one, scaled = (render_image(s * image, SETTINGS, seed=0).levels.astype(int) for s in (1.0, 1e4))
    assert np.mean(np.abs((one - scaled + 128) % 256 - 128) <= 1) > 0.999  # rounding


def test_more_iterations_leave_less_error():
    image = np.random.default_rng(1).random((30, 30))
    final = [render_image(image, replace(SETTINGS, iterations=n), seed=0).signal_error[-1] for n in (0, 3, 10)]
    assert final[0] > final[1] > final[2]


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((0, 5)),
        np.ones((4, 4, 3)),
        np.ones(7),
        np.full((3, 3), np.nan),
        np.array([[1.0, np.inf]]),
        np.array([[1.0, -0.1]]),
        np.ones((2, 2), complex),
        np.array([["a"]]),
        np.broadcast_to(np.uint8(1), (10_000, 10_000)),
    ],
    ids=["empty", "colour", "a line", "NaN", "infinite", "negative", "complex", "text", "enormous"],
)
def test_images_that_cannot_be_shown_are_refused(image):
    with pytest.raises(InputError):
        render_image(image, SETTINGS, seed=0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"wavelength_m": 0.0},
        {"wavelength_m": float("nan")},
        {"fov_rad": (0.0, 0.1)},
        {"fov_rad": (3.0, 0.1)},
        {"gaze_rad": (1.5, 0.0)},
        {"depth_m": -1.0},
        {"method": Zones(0)},
        {"method": Warped(0.0)},
        {"iterations": -1},
    ],
    ids=str,
)
def test_settings_that_make_no_sense_are_refused(wrong):
    key = {Zones(0): "zones", Warped(0.0): "accuracy_rad"}.get(wrong.get("method"), next(iter(wrong)))
    with pytest.raises(UsageError, match=key):
        replace(SETTINGS, **wrong)


def test_amplitudes_are_roots_of_intensities_and_phases_are_the_choice():
    image = np.array([[0.0, 4.0], [9.0, 1.0]])
    points = image_cloud(image, fov_rad=(0.2, 0.1), depth_m=0.5, initial_phase=ZeroPhase())
    assert points.amplitude.tolist() == [0, 2, 3, 1]
    assert not points.phase_rad.any()
    assert np.all(points.distance_m == 0.5)
    assert points.field_tan[0, 0] < points.field_tan[1, 0]
    assert points.field_tan[0, 1] > points.field_tan[2, 1]
    random = image_cloud(image, fov_rad=(0.2, 0.1), initial_phase=RandomPhase(3)).phase_rad
    assert random.min() >= 0
    assert random.max() < 2 * np.pi
    assert np.array_equal(random, (np.random.default_rng(3).random((2, 2)) * 2 * np.pi).ravel())


def test_a_warm_start_is_where_the_last_frame_ended():
    image = np.random.default_rng(2).random((40, 40))
    cloud = image_cloud(image, fov_rad=SETTINGS.fov_rad, initial_phase=RandomPhase(0))
    moved = image_cloud(np.roll(image, 1, axis=1), fov_rad=SETTINGS.fov_rad, initial_phase=RandomPhase(0))
    last = render([cloud], SETTINGS, keep_encoded=True)
    again = render([cloud], SETTINGS, encoder=Ifta(1, warm=last.encoded))
    assert again.signal_error[0] == pytest.approx(last.signal_error[-1], rel=0.05)
    cold = render([moved], SETTINGS, encoder=Ifta(1)).signal_error[0]
    assert again.signal_error[0] < 0.5 * cold
