"""Image errors of built benches: against perturbed paths, the procedures' truth, and the simulated rig's light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holocal.optics.bench import Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.raytrace import reflect
from holocal.records.rig import load_rig
from holocal.records.tolerance_model import Tolerances
from holocal.tolerance import light as light_of
from holocal.tolerance import picture, wavefront
from holocal.tolerance.arrival import arrival, without_plane
from holocal.tolerance.bench_error import STAGES, bench_error, built_bench
from holocal.tolerance.cases import drawn
from holocal.tolerance.design import Design, design_of, sent_light
from procedures._aberration_truth import light_of_spot, panel_points, residuals_rad
from procedures._distortion_truth import illumination, middle, pixel_light
from rigs.simulated.optics import Optics

FREEDOMS = tuple(name for name, _, _ in Tolerances().freedoms())
ZERO = np.zeros(12)
BENCH = np.array([0.15, -0.2, 0.1, 0.1, -0.08, 0.15, 0.2, 0.15, -0.3, 0.1, -0.15, 0.2])  # simulated.toml's


@pytest.fixture(scope="module")
def design() -> Design:
    return design_of(load_rig("simulated").simulated, 515.0)


@pytest.fixture(scope="module")
def small() -> Design:
    return design_of(load_rig("simulated-small").simulated, 515.0)


@pytest.fixture(scope="module")
def truth():
    return load_rig("simulated").simulated.model_dump(mode="json")


def test_the_nominal_bench_has_no_error_anywhere(design, small):
    for one in (design, small):
        found = bench_error(one, ZERO)
        for stage in STAGES:
            numbers = found[stage]
            assert numbers["wavefront_worst_rad"] < 1e-6
            assert numbers["distortion_max_px"] < 1e-6
            assert numbers["field_coverage"] > 0.995  # rays from the panel and rays from the eye: 0.3 % apart
        assert found["before"]["light_fraction"] == pytest.approx(1.0)
        assert found["more"]["nyquist_use"] < 1
        assert found["more"]["lit_share"] == pytest.approx(1.0, abs=0.03)


def _rms(design, seen):
    return wavefront.errors(seen, design, np.ones(len(seen.lit), bool))[0]


def perturbed_path_m(bench: Bench, freedom: int, tangents, slm_m):
    """First-order change of path per degree or millimetre, along the nominal bench's own rays (Fermat)."""
    step = np.radians(1.0) if freedom % 6 < 3 else 1e-3
    axis = np.eye(3)[freedom % 3]
    there = exact_phase(bench, VirtualPoints.at(tangents[:, None]), slm_m, wavelength_m=515e-9)
    origin = bench.pupil_points(there.pupil_m)
    local = np.concatenate([tangents, np.ones((len(tangents), 1))], axis=1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    direction = np.broadcast_to((local @ bench.pupil_axes().T)[:, None], origin.shape)
    _, mirror, onward, _ = reflect(bench, origin, direction)
    if freedom < 6:  # the surface moves by d: the path by (arriving - leaving direction) . normal (normal . d)
        normal = onward - direction
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        moved = np.cross(axis, mirror - bench.mirror_point) if freedom < 3 else np.broadcast_to(axis, mirror.shape)
        along = np.sum(direction * normal, axis=-1) - np.sum(onward * normal, axis=-1)
        return step * along * np.sum(normal * moved, axis=-1)
    axes = bench.nominal_slm_axes
    places = np.concatenate([slm_m, np.zeros((len(slm_m), 1))], axis=1)
    moved = np.cross(axis, places) if freedom < 9 else np.broadcast_to(axis, places.shape)
    return step * np.sum(onward * (moved @ axes.T), axis=-1)


@pytest.mark.parametrize("freedom", range(12), ids=FREEDOMS)
def test_the_wavefront_of_each_small_misalignment_is_that_of_the_perturbed_paths(design, freedom):
    light, amplitude = sent_light(design), 2e-3
    seen = arrival(design, built_bench(design, amplitude * np.eye(12)[freedom]), light)
    inside = np.flatnonzero(seen.lit > 0.1)[::9]
    got = _rms(design, seen)[inside]
    path = perturbed_path_m(design.bench, freedom, light.field_tan[inside], light.slm_m)
    expected = 2 * np.pi / design.wavelength_m * amplitude * np.where(seen.amount[inside] > 0, path, 0.0)
    flat = without_plane(expected, light.pupil_m[inside], seen.amount[inside])
    rms = np.sqrt(np.sum(seen.amount[inside] * flat**2, axis=1) / seen.lit[inside])
    # the second order of 0.002 degrees or mm, and the light's centre moving by 1e-5 m
    np.testing.assert_allclose(got, rms, rtol=0.02, atol=2e-6)


def test_wavefront_and_place_are_those_of_the_procedures_own_truth(design, truth):
    light = sent_light(design)
    design = replace(design, active_m=design.panel.pitch_m)  # as that truth has it
    seen = arrival(design, built_bench(design, BENCH), sent_light(design))
    chosen = [SENT_MIDDLE + 23 * down + along for down, along in ((0, 0), (3, -2), (-4, 1), (-2, 4))]
    tangents = light.field_tan[chosen]
    expected = residuals_rad(
        design.bench, design.panel, truth, tangents, wavelength_m=515e-9, noll=(), coefficients_rad=np.zeros((1, 4, 0))
    )[0]
    got = _rms(design, seen)[chosen]
    np.testing.assert_allclose(got, expected, rtol=0.02)  # 25 x 15 points of the panel against 41 x 25
    x, own = panel_points(design.panel, truth, 515e-9)
    beam = illumination(x, truth)
    for place, tangent in zip(chosen, tangents, strict=True):
        spot = light_of_spot(design.bench, built_bench(design, BENCH), x, own, tangent, 515e-9)
        sent = pixel_light(design.bench, design.panel, x, tangent, 515e-9)
        where = middle(replace(spot, amount=spot.amount * beam * sent), 515e-9)
        # that truth weighs by the pupil's area, not the panel's: a third of a pixel where the wavefront is steep
        assert np.linalg.norm(seen.seen_tan[place] - where) / design.pixel_tan < 0.35
        assert np.linalg.norm(seen.seen_tan[place] - tangent) / design.pixel_tan > 30


SENT_MIDDLE = 11 * 23 + 11


def test_small_errors_grow_as_the_misalignment_and_their_correction_leaves_much_less(design):
    once, twice = (bench_error(design, factor * BENCH) for factor in (0.05, 0.1))
    for name in ("wavefront_median_rad", "distortion_rms_px"):
        assert twice["before"][name] == pytest.approx(2 * once["before"][name], rel=0.03)
        assert twice["after"][name] < 0.05 * twice["before"][name]


def test_a_correction_is_never_worse_than_none(small):
    for index in range(10):
        found = bench_error(small, drawn(Tolerances(), 5, index))
        for name in ("wavefront_median_rad", "wavefront_worst_rad", "distortion_rms_px", "distortion_max_px"):
            assert found["pose"][name] <= found["after"][name] <= found["before"][name] * (1 + 1e-9)
        assert found["after"]["nonuniformity_rms"] <= found["before"]["nonuniformity_rms"]


def test_light_traced_from_the_panel_and_from_the_eye_is_the_same(design, small):
    for one in (design, small):
        forward = light_of.nominal_brightness(one)
        back = light_of.of_true_hologram(one, one.bench).brightness
        inside = forward.inside
        np.testing.assert_allclose(back.value[inside], forward.value[inside], rtol=0.02)
        np.testing.assert_allclose(back.assigned[inside], forward.assigned[inside], rtol=0.03)  # 27 points of the pupil


def test_the_light_of_a_direction_is_what_the_simulated_rig_shows_of_it():
    rig = load_rig("simulated-small", {"slm.width": 480, "slm.height": 270}).simulated
    design = design_of(rig, 515.0)
    light = sent_light(design)
    whole = np.ones_like(light.sent)  # one direction alone, on the whole panel
    power = design.beam(light.slm_m) * design.envelope(light.direction[..., :2])
    seen = arrival(design, built_bench(design, BENCH), replace(light, sent=whole, power=power))
    optics, panel = Optics(rig), Panel(480, 270, design.panel.pitch_m)
    pixels = np.stack(np.meshgrid(panel.x_m, panel.y_m), axis=-1)
    carrier = 2 * np.pi * pixels @ np.array(panel.illumination_frequency_per_m)
    shown, expected = [], []
    for down, along in ((0, 0), (3, 2), (-4, -1), (1, -5)):
        place = SENT_MIDDLE + 23 * down + along
        phase = exact_phase(design.bench, VirtualPoints.at(light.field_tan[place]), pixels, wavelength_m=515e-9)
        levels = np.round((phase.phase_rad - carrier) / (2 * np.pi) * 256).astype(np.int64) % 256
        picture_power = optics.power(levels.astype(np.uint8), f"{down} {along}", 515e-9)
        shown.append(float(picture_power.sum()))
        expected.append(float(seen.power[place]))
    ratio = np.array(shown) / np.array(expected)
    # the diffraction of the pupil's rim, 1 to 2 % of the light on so small a panel; levels to 8 bits
    np.testing.assert_allclose(ratio / ratio.mean(), 1.0, atol=0.03)
    assert max(expected) / min(expected) > 1.3


def test_an_evenly_dark_or_unseen_bench_is_said_to_be_unknown_not_good(small):
    found = bench_error(small, 8 * np.eye(12)[0])
    assert np.isnan(found["after"]["distortion_max_px"])
    assert found["after"]["field_coverage"] < 0.05
    assert found["pose"]["light_fraction"] < 0.05


def test_a_panel_turned_too_far_is_asked_for_more_than_its_nyquist_frequency(design):
    use = [bench_error(design, angle * np.eye(12)[7])["more"]["nyquist_use"] for angle in (0.0, 1.5, 4.0)]
    assert use[0] < use[1] < use[2]
    assert use[2] > 1


def test_maps_are_fitted_to_the_field_and_judged_elsewhere():
    fitted, zones = picture.fitted_rows(), wavefront.zone_rows()
    assert (np.count_nonzero(fitted), np.count_nonzero(zones)) == (113, 25)
    grid = zones.reshape(23, 23)
    assert np.array_equal(np.flatnonzero(grid.any(axis=0)) - 4, [1, 4, 7, 10, 13])  # middles of fifths of 15 cells
