"""What each effect of the simulated bench does to the picture, alone, against a closed form or the plain sum."""

import numpy as np
import pytest

from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.raytrace import trace_to_pupil
from holocal.records.rig import load_rig
from rigs.simulated.aperture import PanelToPupil
from rigs.simulated.camera import PupilToPicture
from rigs.simulated.direct import NODES, DirectSum, relative_error
from rigs.simulated.image_plane import field_along
from rigs.simulated.kernel import Box, interpolate
from rigs.simulated.optics import Optics, bench_of
from rigs.simulated.panel import before_modulation, modulation, pixels_of
from rigs.simulated.rig import SimulatedRig

WAVELENGTH_M = 515e-9
TINY = ("slm.width=240", "slm.height=136", "optics.wavelengths_nm=[473, 515, 639]")
CAMERA = ("camera.width=40", "camera.height=36", "camera.field_deg=3.0")


def tables_of(*overrides):
    return load_rig("simulated-ideal", [*TINY, *CAMERA, *overrides]).simulated


def random_levels(tables, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (tables.slm.height, tables.slm.width), dtype=np.uint8)


def picture(levels, *overrides, wavelength_m=WAVELENGTH_M):
    """Power on every pixel, before the sensor."""
    return Optics(tables_of(*overrides)).power(levels, "", wavelength_m).astype(float)


def spot_levels(tables, tangent=(0.0, 0.0), distance_m=np.inf):
    """The hologram of a point: its exact phase, less the tilt of the illumination, to the nearest level."""
    panel = pixels_of(tables.slm)
    half_x, half_y = panel.half_size_m
    box = Box(-half_x, half_x, -half_y, half_y)
    nodes = np.stack(np.meshgrid(*box.nodes(NODES)), axis=-1).reshape(-1, 2)
    points = VirtualPoints.at(np.array(tangent), distance_m)
    phase = exact_phase(bench_of(tables), points, nodes, wavelength_m=WAVELENGTH_M).phase_rad
    over = interpolate(box, phase.reshape(NODES, NODES)).on_grid(panel.x_m, panel.y_m)
    turns = over / (2 * np.pi) - panel.illumination_frequency_per_m[1] * panel.y_m[:, None]
    return np.rint(turns * 256).astype(np.int64).astype(np.uint8)  # an overflow is a whole turn


def both_fields(tables, light, before, tangents, *, focus_m=np.inf, wavelength_m=WAVELENGTH_M):
    """The rig's field and the plain sum's along tangents (n, 2), for light (height, width) on the panel."""
    edge_m, panel = tables.optics.pupil_edge_mm * 1e-3, pixels_of(tables.slm)
    to_pupil = PanelToPupil(
        bench_of(tables), panel, wavelength_m,
        illumination=before_modulation(tables.slm, tables.illumination, wavelength_m),
        fill_factor=tables.slm.fill_factor, pupil_edge_m=edge_m,
    )  # fmt: skip
    sines = (tangents / np.sqrt(1 + np.sum(tangents**2, axis=1, keepdims=True))).T
    found = field_along(to_pupil.grid, to_pupil.field(light), wavelength_m, (sines[0], sines[1]), focus_m=focus_m)
    exact = DirectSum(bench_of(tables), panel, wavelength_m, edge_m, before, tables.slm.fill_factor)
    return found, exact.field(light, VirtualPoints.at(tangents, focus_m))


def around(centre_deg, step_deg=0.08, count=4):
    offset = (np.arange(count) - (count - 1) / 2) * np.radians(step_deg)
    dx, dy = np.meshgrid(offset, offset)
    return np.tan(np.radians(centre_deg)) + np.stack([dx.ravel(), dy.ravel()], axis=1)


def disc_coordinates(panel):
    """x and y over the circle round the panel, in units of its radius."""
    radius = np.hypot(*panel.half_size_m)
    return np.meshgrid(panel.x_m / radius, panel.y_m / radius)


# ---- the panel


def test_a_curved_panel_adds_its_path_to_every_pixel():
    tables = tables_of("slm.flatness_nm=[[4, 60.0], [6, -25.0]]")
    x, y = disc_coordinates(pixels_of(tables.slm))
    for wavelength_m in (473e-9, 639e-9):  # the same path is more phase in blue
        path = 60e-9 * np.sqrt(3) * (2 * (x * x + y * y) - 1) - 25e-9 * np.sqrt(6) * (x * x - y * y)
        before = np.exp(2j * np.pi / wavelength_m * path)
        light = modulation(tables.slm, random_levels(tables), wavelength_m)
        found, exact = both_fields(tables, light, before, around((1.0, -0.5)), wavelength_m=wavelength_m)
        assert relative_error(found, exact) < 0.01
        _, flat = both_fields(tables, light, None, around((1.0, -0.5)), wavelength_m=wavelength_m)
        assert relative_error(flat, exact) > 0.1  # the same sum without it is another picture


def test_a_curved_panel_takes_from_a_spots_peak_what_its_phase_does_to_the_mean():
    tables, fine = tables_of(), ("camera.field_deg=0.6",)
    x, y = disc_coordinates(pixels_of(tables.slm))
    phase = 2 * np.pi / 515 * 80 * np.sqrt(3) * (2 * (x * x + y * y) - 1)
    levels = spot_levels(tables)
    flat, curved = picture(levels, *fine), picture(levels, *fine, "slm.flatness_nm=[[4, 80.0]]")
    strehl = np.abs(np.exp(1j * phase).mean()) ** 2
    at = np.unravel_index(flat.argmax(), flat.shape)
    assert curved[at] / flat[at] == pytest.approx(strehl, rel=0.02)  # the pupil cuts 1 % of the spot's light
    assert strehl < 0.8


def test_light_of_the_frames_between_pixels_comes_to_a_focus_at_order_zero():
    # A pupil of 9 mm takes in order zero, 3.3 mm above its middle; in the thesis's 3 mm it is outside.
    tables = tables_of("optics.pupil_mm=9.0", "slm.fill_factor=0.8")
    panel = pixels_of(tables.slm)
    light = modulation(tables.slm, random_levels(tables), WAVELENGTH_M)
    to_pupil = PanelToPupil(bench_of(tables), panel, WAVELENGTH_M, fill_factor=0.8)
    power = np.abs(to_pupil.field(light)) ** 2 * np.prod(to_pupil.grid.pitch_m)
    x, y = np.meshgrid(to_pupil.grid.x_m, to_pupil.grid.y_m)
    peak = np.unravel_index(power.argmax(), power.shape)
    along = np.array([[0.0, tilt := WAVELENGTH_M * panel.illumination_frequency_per_m[1], np.sqrt(1 - tilt**2)]])
    wanted = trace_to_pupil(bench_of(tables), np.zeros((1, 2)), along).landing_m[0]
    assert np.hypot(x[peak] - wanted[0], y[peak] - wanted[1]) < 0.06e-3  # the focus is 0.05 mm wide
    near = np.hypot(x - x[peak], y - y[peak]) < 0.25e-3
    ring = (np.hypot(x - x[peak], y - y[peak]) < 0.6e-3) & ~near
    focus = power[near].sum() - power[ring].mean() * near.sum()
    # Random levels have no mean: only the frames' share, 1 - 0.8 of the amplitude, is coherent. The circle of 0.25 mm
    # leaves out 5 % of the side lobes of the small panel's focus.
    whole = panel.width * panel.height * panel.pitch_m**2
    assert focus / whole == pytest.approx((1 - 0.8) ** 2, rel=0.08)
    for direction in ((0.0, 0.0), (0.5, -0.8)):
        found, exact = both_fields(tables, light, None, around(direction, 0.02))
        assert relative_error(found, exact) < 0.01


def test_crosstalk_takes_from_a_fine_grating_what_the_blurred_pixel_does():
    # Rows of two levels in turn send light half an order from order zero: into the middle of the pupil.
    half = np.pi * 40 / 256  # of the phase between the rows
    levels = np.zeros((136, 240), np.uint8)
    stray = picture(levels, "camera.field_deg=20.0").sum()  # of order zero, past the pupil's rim
    levels[::2] = 40

    def light_of(*overrides, left=1.0):
        return picture(levels, "camera.field_deg=20.0", *overrides).sum() - stray * np.cos(half * left) ** 2

    sharp = light_of()
    for sigma_px in (0.3, 0.5):
        # half an order is half a cycle per pixel: a square's Gaussian blur, averaged over squares, and its aliases
        f = 0.5 + np.arange(-40, 40)
        left = np.sum(np.exp(-2 * (np.pi * sigma_px * f) ** 2) * np.sinc(f) ** 2)
        blurred = light_of(f"slm.crosstalk_um={sigma_px * 3.74}", left=left)
        assert blurred / sharp == pytest.approx(
            (np.sin(half * left) / np.sin(half)) ** 2, rel=0.05
        )  # the panel's first and last rows have one neighbour


def test_a_measured_response_gives_each_level_its_phase():
    table = 1.7 * np.pi * (np.arange(256) / 255) ** 1.3  # neither linear nor 2 pi

    def light_of(level, *overrides, wavelength_m=WAVELENGTH_M):
        levels = np.zeros((136, 240), np.uint8)
        levels[::2] = level  # of such a grating the pupil gets sin^2 of half the phase difference
        return picture(levels, "camera.field_deg=20.0", *overrides, wavelength_m=wavelength_m).sum()

    response = f"slm.response={[float(phase) for phase in table]}"
    full = light_of(128)  # "ideal": a difference of pi
    for level in (60, 150, 255):
        assert light_of(level) / full == pytest.approx(np.sin(np.pi * level / 256) ** 2, abs=0.015)
        assert light_of(level, response) / full == pytest.approx(np.sin(table[level] / 2) ** 2, abs=0.015)
    red = light_of(128, wavelength_m=639e-9)
    held = light_of(255, response, wavelength_m=639e-9) / red
    scaled = light_of(255, response, "slm.response_nm=515.0", wavelength_m=639e-9) / red
    assert held == pytest.approx(np.sin(table[255] / 2) ** 2, abs=0.015)
    assert scaled == pytest.approx(np.sin(table[255] / 2 * 515 / 639) ** 2, abs=0.015)  # the same path difference


# ---- the beam


def test_a_gaussian_beam_lights_the_spot_by_its_mean_amplitude():
    tables = tables_of()
    panel = pixels_of(tables.slm)
    x, y = np.meshgrid(panel.x_m, panel.y_m)
    levels, fine = spot_levels(tables), ("camera.field_deg=0.6",)
    gaussian = ("illumination.profile=gaussian", "illumination.waist_mm=0.3")
    amplitude = np.exp(-(x**2 + y**2) / 0.3e-3**2)  # 0.3 mm: where the intensity is 1/e^2
    flat, lit = picture(levels, *fine), picture(levels, *fine, *gaussian)
    at = np.unravel_index(flat.argmax(), flat.shape)
    assert lit[at] / flat[at] == pytest.approx(amplitude.mean() ** 2, rel=0.03)  # less light in side lobes is cut off
    wide = ("camera.field_deg=8.0",)
    share = picture(levels, *wide, *gaussian).sum() / picture(levels, *wide).sum()
    assert share == pytest.approx(np.mean(amplitude**2), rel=0.04)


# ---- the camera's lens


def test_a_near_point_is_sharp_where_the_camera_is_focused():
    wide = ("slm.width=960", "slm.height=136", "camera.field_deg=0.5")
    levels = spot_levels(tables_of(*wide), distance_m=0.25)
    peaks = {focus: picture(levels, *wide, f"camera.focus_m={focus}").max() for focus in ("0.2", "0.25", "0.33", "inf")}
    assert max(peaks, key=peaks.get) == "0.25"
    assert peaks["0.25"] > 2 * peaks["inf"]
    assert picture(levels, *wide).max() == peaks["inf"]  # left out, it is infinity


def test_a_focused_camera_sees_what_the_plain_sum_over_a_near_points_phase_sees():
    tables = tables_of("slm.width=480")
    light = modulation(tables.slm, random_levels(tables), WAVELENGTH_M)
    found, exact = both_fields(tables, light, None, around((0.0, 0.0), 0.02), focus_m=0.3)
    assert relative_error(found, exact) < 0.01
    far, _ = both_fields(tables, light, None, around((0.0, 0.0), 0.02))
    assert relative_error(far, exact) > 0.05


def test_a_smaller_entrance_pupil_passes_its_area_and_blurs():
    tables = tables_of("camera.pupil_mm=1.6")
    levels, wide = random_levels(tables), ("camera.field_deg=24.0",)
    whole, stopped = picture(levels, *wide), picture(levels, *wide, "camera.pupil_mm=1.6")
    # |T|^2 of a raised cosine of width e at radius R has the area pi (R^2 - R e / 4 + ...): 0.2 mm takes 0.05 mm of R
    area = [np.pi * (r**2 - 0.25 * 0.2 * r) for r in (1.5, 0.8)]
    assert stopped.sum() / whole.sum() == pytest.approx(area[1] / area[0], rel=0.08)  # some 1000 speckles
    light = modulation(tables.slm, levels, WAVELENGTH_M)
    found, exact = both_fields(tables, light, None, around((1.0, -0.5)))
    assert relative_error(found, exact) < 0.01
    # a direction of a panel wider than the pupil's view of it: the spot is the pupil's diffraction disc
    wider = ("slm.width=960", "slm.height=960", "camera.field_deg=0.4")
    spot = spot_levels(tables_of(*wider))
    sharp, blurred = picture(spot, *wider, "camera.pupil_mm=1.0"), picture(spot, *wider, "camera.pupil_mm=0.5")
    width = [np.sqrt(np.sum(p > p.max() / 2)) for p in (sharp, blurred)]
    assert width[1] / width[0] == pytest.approx(1.0 / 0.5, rel=0.3)  # whole pixels, soft edges


@pytest.mark.parametrize("turn_deg", [0.0, 20.0])
@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (-4.0, 0.0), (3.0, 200.0 / 3)])
def test_lens_and_rotation_move_a_spot_as_opencv_has_it(turn_deg, k1, k2):
    tangent = np.array([np.tan(np.radians(4.5)), np.tan(np.radians(-3.0))])
    camera = ("camera.width=121", "camera.height=101", "camera.field_deg=14.0")
    seen = picture(
        spot_levels(tables_of(), tangent), *camera, f"camera.rotation_deg={turn_deg}", f"camera.k1={k1}",
        f"camera.k2={k2}",
    )  # fmt: skip
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turned = np.array([c * tangent[0] + s * tangent[1], -s * tangent[0] + c * tangent[1]])  # the camera turned, not it
    sq = np.sum(turned**2)
    u, v = turned * (1 + k1 * sq + k2 * sq**2)
    pixels = 121 / (2 * np.tan(np.radians(7.0)))
    wanted = (60 + u * pixels, 50 - v * pixels)
    row, column = np.unravel_index(seen.argmax(), seen.shape)
    near = np.s_[row - 3 : row + 4, column - 3 : column + 4]
    y, x = np.indices(seen.shape)
    found = [np.sum(seen[near] * axis[near]) / np.sum(seen[near]) for axis in (x, y)]
    assert found == pytest.approx(wanted, abs=0.15)  # side lobes in the window


# ---- all of them, one at a time

# key -> (its value that means "not there", one that shows)
EFFECTS = {
    "misalignment.mirror_rotation_deg": ("[0.0, 0.0, 0.0]", "[0.2, -0.1, 0.3]"),
    "misalignment.mirror_shift_mm": ("[0.0, 0.0, 0.0]", "[0.1, 0.1, -0.1]"),
    "misalignment.slm_rotation_deg": ("[0.0, 0.0, 0.0]", "[0.2, 0.1, 0.5]"),
    "misalignment.slm_shift_mm": ("[0.0, 0.0, 0.0]", "[0.05, -0.05, 0.2]"),
    "slm.response": ('"ideal"', str([0.02 * i for i in range(256)])),
    "slm.flatness_nm": ("[]", "[[4, 80.0]]"),
    "slm.fill_factor": (None, "0.8"),
    "slm.crosstalk_um": ("0.0", "1.5"),
    "illumination.profile": ("flat", "gaussian"),
    "illumination.power_noise": ("0.0", "0.2"),
    "camera.focus_m": ("inf", "0.06"),
    "camera.pupil_mm": ("3.0", "2.0"),
    "camera.rotation_deg": ("0.0", "3.0"),
    "camera.k1": ("0.0", "10.0"),
    "camera.k2": ("0.0", "100.0"),
    "camera.psf_px": ("0.0", "0.8"),
    "camera.shot_noise": ("false", "true"),
    "camera.read_noise_e": ("0.0", "6.0"),
    "camera.dark_e_per_s": ("0.0", "200.0"),
    "camera.hot_pixels": ("0", "9"),
}
SMALL = (
    *("slm.width=120", "slm.height=72", "illumination.waist_mm=0.3", "camera.width=24", "camera.height=20"),
    *("camera.field_deg=8.0", "optics.wavelengths_nm=[515]"),
)


def counts(values):
    """A frame of the rig whose file has these keys, of random levels; a value of None leaves the key out."""
    given = [f"{key}={value}" for key, value in values.items() if value is not None]
    rig = SimulatedRig(load_rig("simulated-ideal", [*SMALL, *given]))
    rig.slm.show(np.random.default_rng(0).integers(0, 256, (72, 120), dtype=np.uint8))
    rig.light.on()
    rig.camera.set_exposure(0.5)
    return rig.camera.grab().counts


ALL_ON = {key: on for key, (_, on) in EFFECTS.items()}
# The file `simulated-ideal` gives these itself, as off.
GIVEN_BY_THE_FILE = {
    *("slm.response", "illumination.profile", "camera.shot_noise", "camera.read_noise_e", "camera.dark_e_per_s"),
    "camera.hot_pixels",
}


@pytest.fixture(scope="module")
def with_all():
    return counts(ALL_ON)


@pytest.mark.parametrize("key", EFFECTS)
def test_each_effect_changes_the_picture_and_can_be_switched_off_alone(key, with_all):
    off, on = EFFECTS[key]
    alone, without = counts({key: on}), counts({})
    assert not np.array_equal(alone, without)
    assert np.array_equal(counts({key: off}), without)
    others = counts(ALL_ON | {key: off})
    assert not np.array_equal(others, with_all)  # it is felt among all the others too
    if key not in GIVEN_BY_THE_FILE:
        assert np.array_equal(others, counts(ALL_ON | {key: None}))


def test_the_truth_names_what_the_bench_has():
    flatness, response = [[4, 60.0], [7, -5.0]], [0.02 * i for i in range(256)]
    truth = SimulatedRig(
        load_rig(
            "simulated-small",
            [f"slm.flatness_nm={flatness}", f"slm.response={response}", "slm.response_nm=515", "camera.k1=-0.2",
             "camera.pupil_mm=2.5", "camera.focus_m=0.5", "illumination.power_noise=0.005"],
        )
    ).truth()  # fmt: skip
    assert truth["slm"]["flatness_nm"] == flatness
    assert truth["response_rad"]["515"] == pytest.approx(response)
    assert truth["response_rad"]["639"] == pytest.approx([515 / 639 * phase for phase in response])
    assert truth["camera"]["k1"] == -0.2
    assert (truth["camera"]["pupil_mm"], truth["camera"]["focus_m"]) == (2.5, 0.5)
    assert truth["illumination"]["power_noise"] == 0.005 and truth["fill_factor"] == 0.93


def test_a_known_pattern_is_not_computed_again(monkeypatch):
    optics, calls = Optics(tables_of()), []
    power = PupilToPicture.power
    monkeypatch.setattr(PupilToPicture, "power", lambda self, field: calls.append(1) or power(self, field))
    levels = [random_levels(tables_of(), seed) for seed in range(10)]
    first = optics.power(levels[0], "0", WAVELENGTH_M)
    for name in ("1", "0", "1", "0"):
        optics.power(levels[int(name)], name, WAVELENGTH_M)
    assert len(calls) == 2
    for i in range(2, 10):  # eight others
        optics.power(levels[i], str(i), WAVELENGTH_M)
    assert np.array_equal(optics.power(levels[0], "0", WAVELENGTH_M), first)
    assert len(calls) == 11
