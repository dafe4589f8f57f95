"""Zones: the table, the price of sharing a wavefront, and the sum against the exact one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.footprint import row_spans, sample_footprint, soft_span
from holocal.hologram.grid import Grid, panel_grid, resample_compact, synthesis_grid
from holocal.hologram.reference import pupil_window, reference_turns
from holocal.hologram.settings import HologramSettings, Zones
from holocal.hologram.wavefront_error import zone_wavefront_errors
from holocal.hologram.zone_sum import zone_sum
from holocal.hologram.zones import point_table, table_points, zone_plan
from holocal.optics.bench import Bench, Panel, Pose
from holocal.optics.phase_function import VirtualPoints, exact_phase, pupil_rim
from holocal.optics.raytrace import connect
from holocal.optics.series import fit_series

DEG = np.pi / 180
PITCH = 3.74e-6
FULL = HologramSettings(Panel(3840, 2160, PITCH), Bench(), 515e-9, (25 * DEG, 25 * DEG), method=Zones())
SMALL = HologramSettings(Panel(128, 96, PITCH), Bench(), 515e-9, (8 * DEG, 6 * DEG), method=Zones())


@pytest.mark.slow
def test_zone_counts_reproduce_the_table_of_zone_errors():
    # docs/physics.md 4: central 25 degrees, 515 nm, footprints as far as they lie on the panel
    table = {1: 5.10, 2: 3.97, 3: 2.67, 5: 1.55, 7: 1.10}
    found = zone_wavefront_errors(FULL, list(table))
    for error, wanted in zip(found, table.values(), strict=True):
        assert error == pytest.approx(wanted, rel=0.1)


def test_five_by_five_zones_take_fewer_than_fifty_traced_points():
    # thesis 3.1: "phase functions of less than 50 individual points"
    for zones in (1, 2, 3, 4, 5):
        points = table_points(replace(FULL, method=Zones(zones)))
        assert zones**2 + 4 <= len(points) < 50
    assert len(np.unique(np.round(table_points(FULL), 9), axis=0)) == 49


def test_the_first_points_of_the_table_are_zone_centres_from_the_top_row_down():
    points = table_points(replace(FULL, method=Zones(5)))[:25].reshape(5, 5, 2)
    assert np.all(np.diff(points[:, 0, 1]) < 0)
    assert np.all(np.diff(points[0, :, 0]) > 0)
    assert np.allclose(points[2, 2], 0)


@pytest.mark.parametrize("depth_m", [np.inf, 0.25])
def test_points_between_the_traced_ones_come_out_by_interpolation(depth_m):
    # Compared as slopes at the footprint's centre: one speckle grain is 2 pi over the footprint of 12 mm = 520 rad/m,
    # and an image pixel is 3.4 grains.
    settings = replace(FULL, depth_m=depth_m)
    table = point_table(settings)
    rng = np.random.default_rng(0)
    tangents = rng.uniform(-1, 1, (40, 2)) * np.tan(12 * DEG)
    functions = table.at(tangents)
    centre = functions.centre_m
    step = 1e-5
    found, wanted = [], []
    for shift in np.eye(2) * step:
        ahead, behind = (
            exact_phase(FULL.bench, VirtualPoints.at(tangents, depth_m), centre + s, wavelength_m=515e-9).phase_rad
            for s in (shift, -shift)
        )
        wanted.append((ahead - behind) / (2 * step))
        found.append((functions.phase(centre + shift) - functions.phase(centre - shift)) / (2 * step))
    grains = (np.array(found) - wanted) / 520
    assert np.sqrt(np.mean(grains**2)) < 0.3
    assert np.abs(grains).max() < 1.2  # at the field's edge, where the fit is held from one side only


def test_the_reference_is_the_path_from_the_pupils_centre():
    rng = np.random.default_rng(1)
    for bench in (Bench(), Bench(mirror=Pose((DEG, -DEG, DEG), (1e-3, 1e-3, -1e-3)))):
        settings = replace(FULL, bench=bench, gaze_rad=(0.1, -0.05))
        series = reference_turns(settings)
        x, y = rng.uniform(-1, 1, 20) * 7.18e-3, rng.uniform(-1, 1, 15) * 4.03e-3
        path = connect(bench, np.stack(np.meshgrid(x, y), axis=-1), np.zeros(2), gaze_rad=(0.1, -0.05)).path_m
        # degree 12 leaves 1e-5 rad; 3e6 rad of path cost 1e-9 of rounding
        assert np.abs(series.on_grid(x, y) + path / 515e-9).max() * 2 * np.pi < 1e-3


def test_the_window_holds_the_pupils_image_and_little_else():
    window = pupil_window(FULL)
    rng = np.random.default_rng(2)
    slm = rng.uniform(-1, 1, (200, 2)) * FULL.panel.half_size_m
    angle = 2 * np.pi * rng.random(200)
    rim = 1.5e-3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for part, inside in ((0.98, True), (2.2, False)):  # magnifications over the panel differ by a factor of 1.5
        towards = connect(FULL.bench, slm, part * rim).slm_direction - connect(FULL.bench, slm, 0 * rim).slm_direction
        f = towards[:, :2] / 515e-9
        found = [bool(window.contains(f[i, :1], f[i, 1:])[0, 0]) for i in range(200)]
        assert all(found) if inside else not any(found)
    # measured on the nominal bench: 0.61 of the sampling rate wide, 0.46 high
    assert np.allclose(np.array(window.half_size_per_m) * PITCH, [0.303, 0.233], atol=0.003)


def exact_sum(settings, tangents, strengths, x, y):
    """Return sum_p A_p a_p exp(i phi_p) with every point's own exact phase, and each point's footprint."""
    slm = np.stack(np.meshgrid(x, y), axis=-1)
    waves = []
    for tangent, strength in zip(tangents, strengths, strict=True):
        point = VirtualPoints.at(tangent, settings.depth_m)
        found = exact_phase(settings.bench, point, slm, wavelength_m=settings.wavelength_m, gaze_rad=settings.gaze_rad)
        inside = np.linalg.norm(found.pupil_m, axis=-1) <= settings.bench.pupil_diameter_m / 2
        waves.append(strength * inside * np.exp(1j * found.phase_rad))
    return np.sum(waves, axis=0)


MISALIGNED = Bench(mirror=Pose((0.2 * DEG, -0.1 * DEG, 0.3 * DEG), (2e-4, -1e-4, 3e-4)))


@pytest.mark.parametrize(
    "settings",
    [
        replace(SMALL, method=Zones(9)),
        replace(SMALL, method=Zones(9), depth_m=0.3),
        replace(SMALL, method=Zones(7), gaze_rad=(0.06, -0.04)),
        replace(SMALL, method=Zones(7), bench=MISALIGNED, wavelength_m=639e-9),
        replace(SMALL, method=Zones(7), panel=Panel(97, 64, 8e-6)),
    ],
    ids=["infinity", "0.3 m", "gaze", "misaligned, red", "odd width, coarse pixels"],
)
def test_many_zones_agree_with_the_exact_sum_over_points(settings):
    # A zone of 9 x 9 over 8 x 6 degrees is 0.9 degrees wide: its points share the wavefront within 0.05 rad over this
    # small panel. What is left is the table's piston (0.1 rad), which the seed's random phase makes meaningless.
    rng = np.random.default_rng(3)
    tangents, strengths = some_points(rng, np.tan(np.array(settings.fov_rad) / 2) * 0.8, 6)
    grid, plan = panel_grid(settings.panel), zone_plan(settings)
    found, dark = zone_sum(plan, grid, tangents, strengths)
    assert 0 < dark < len(plan.zones)
    wanted = exact_sum(settings, tangents, strengths, grid.x_m, grid.y_m)
    reference = np.exp(2j * np.pi * plan.reference_turns.on_grid(grid.x_m, grid.y_m))
    error = found.numpy() * reference - wanted
    assert np.linalg.norm(error) < 0.15 * np.linalg.norm(wanted)


def some_points(rng, half, count):
    """Return tangents within +-half and complex amplitudes."""
    amplitude = rng.uniform(0.5, 1, count)
    strengths = (amplitude * np.exp(2j * np.pi * rng.random(count))).astype(np.complex64)
    return rng.uniform(-1, 1, (count, 2)) * half, strengths


def test_one_point_at_a_zone_centre_is_exact_to_the_fit_of_its_phase():
    settings = replace(SMALL, method=Zones(3))
    plan, grid = zone_plan(settings), panel_grid(settings.panel)
    found = zone_sum(plan, grid, np.zeros((1, 2)), np.full(1, np.exp(0.4j), np.complex64))[0].numpy()
    found = found * np.exp(2j * np.pi * plan.reference_turns.on_grid(grid.x_m, grid.y_m))
    wanted = exact_sum(settings, np.zeros((1, 2)), [np.exp(0.4j)], grid.x_m, grid.y_m)
    # N = 10 leaves 0.05 rad rms, up to 0.1 at the footprint's rim; the shift's interpolation another 0.05
    assert np.abs(np.angle(found / wanted)).max() < 0.15
    assert np.allclose(np.abs(found), 1, atol=1e-3)


def test_a_coarser_grid_holds_the_same_hologram():
    settings = replace(FULL, panel=Panel(960, 540, PITCH), fov_rad=(12 * DEG, 10 * DEG))
    rng = np.random.default_rng(5)
    scene = some_points(rng, np.tan(5 * DEG), 144)
    plan = zone_plan(settings)
    coarse_grid, fine_grid = synthesis_grid(plan, settings.panel), panel_grid(settings.panel)
    assert coarse_grid.columns < 0.75 * fine_grid.columns
    assert coarse_grid.rows < 0.75 * fine_grid.rows
    coarse, fine = (zone_sum(plan, g, *scene)[0].numpy() for g in (coarse_grid, fine_grid))
    # compared as spectra in the signal window, each on its own samples; theirs start half a step from the panel's edge
    spectra = [
        WindowedTransform(grid.rows, grid.columns, 90, 180).forward(torch.from_numpy(field))
        for grid, field in ((coarse_grid, coarse), (fine_grid, fine))
    ]
    moved = resample_compact(spectra[0], (90, 180), coarse_grid, fine_grid)
    # the panel's and the footprints' edges alias a little, differently on the two grids
    assert float(torch.linalg.vector_norm(moved - spectra[1])) < 0.03 * float(torch.linalg.vector_norm(spectra[1]))


def test_footprints_off_the_panel_are_left_out_and_named():
    settings = replace(FULL, panel=Panel(960, 540, PITCH))
    plan = zone_plan(settings)
    assert (0, 0) in plan.missing
    assert (2, 2) not in plan.missing
    assert len(plan.missing) + len(plan.zones) == 25
    assert "zone row 1, column 1: its footprint misses the panel" in plan.left_out()


def test_row_spans_are_the_chords_of_a_circle():
    rim = pupil_rim(2.0, 4096) + np.array([0.3, -0.2])
    y = np.array([-1.5, -1.0, -0.2, 0.5, 0.9])
    left, right = row_spans(rim, y)
    half = np.sqrt(np.maximum(1 - (y + 0.2) ** 2, 0))
    assert left[0] > right[0]
    assert left[-1] > right[-1]
    assert np.allclose(left[1:-1], (0.3 - half)[1:-1], atol=1e-5)
    assert np.allclose(right[1:-1], (0.3 + half)[1:-1], atol=1e-5)


def test_footprint_samples_average_like_the_area():
    rim = pupil_rim(2.0, 1024)
    points, area = sample_footprint(rim, (5.0, 5.0), count=60)
    assert area.sum() == pytest.approx(1)
    assert np.allclose(area @ points, 0, atol=1e-3)
    assert area @ points[:, 0] ** 2 == pytest.approx(0.25, rel=0.01)  # disc: r^2 / 4
    cut, weight = sample_footprint(rim + 5.5, (5.0, 5.0))
    assert cut.max() <= 5.0
    assert weight.sum() == pytest.approx(1)
    assert not len(sample_footprint(rim + 7, (5.0, 5.0))[0])


def test_soft_spans_have_the_area_of_the_span():
    x = np.arange(20.0)
    mask = soft_span(x, np.array([3.2, 9.0, np.inf]), np.array([7.9, 9.6, -np.inf]), 1.0)
    assert mask.dtype == np.float32
    assert np.allclose(mask.sum(axis=1), [4.7, 0.6, 0.0], atol=1e-5)
    assert mask.max() <= 1


def test_a_series_gives_back_a_polynomial():
    def cubic(p):
        return np.stack([1 + p[:, 0] ** 3 - 2 * p[:, 1], p[:, 0] * p[:, 1] ** 2], axis=-1)

    series = fit_series(cubic, degree=3, centre=(0.3, -1.0), half=(2.0, 0.5))
    x, y = np.linspace(-1, 2, 5), np.linspace(-1.4, -0.6, 4)
    wanted = cubic(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(4, 5, 2)
    assert np.allclose(series.on_grid(x, y), wanted, atol=1e-13)
    assert np.allclose((series + (-series)).on_grid(x, y), 0)


def test_grids_have_their_samples_where_pixels_are():
    panel = Panel(7, 4, 2e-6)
    grid = panel_grid(panel)
    assert np.allclose(grid.x_m, panel.x_m)
    assert np.allclose(grid.y_m, panel.y_m)
    assert Grid(2, 2, 1.0, 3.0).y_m.tolist() == [1.5, -1.5]
