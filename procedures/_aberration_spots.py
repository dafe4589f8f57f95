"""A spot in every zone of the field: directions, brightness, known defocus; and the frames that show them.

Directions lie irregularly, so that a picture shifted by more than half a pitch is still told apart. A zone's pupil is
what the panel lights of the eye's: often a strip, on a small panel nothing. The known defocus is scaled to it, so that
every spot is as many pixels wide; brightness is shared out so that all reach the same counts.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.spots import BLOCK, SpotWaves, analyse, derivative, spot_waves, synthesise
from holocal.optics.zernike import zernike
from holocal.records.facts import RigFacts

Array = NDArray[np.float64]
Levels = NDArray[np.uint8]

JITTER = 0.15  # of the zones' pitch
SPOT_PX = 20.0  # width of a defocused spot along the longer side of its pupil
REACH_M = 2.2e-3  # of the pupil, from its centre: the bench's own may lie 0.6 mm off
SOFT_M = 0.4e-3
EDGE_M = 2e-4
LEAST_LIT = 0.004  # of the pupil's area: a zone with less sends no light worth measuring
LEAST_COUNT = 3  # zones
MOST_BOOST = 12.0  # of a zone's amplitude over the brightest zone's
NEARBY_M, NEARBY_COUNT = 2.5e-3, 80  # points of the panel whose light says how directions differ
_BLOCK = 8


@dataclass(frozen=True)
class Nearby:
    """How directions near a zone's own differ from it, on the nominal bench.

    `relief_m` (zones, 2, 2) is R = d q / d s at q = 0: q the pupil point of light from a place of
    the panel, s direction sines; `relief_slope` (zones, 2, 2, 2) d R_ij / d q_k; `envelope` (zones, 2) the logarithmic
    slope by s of the amplitude that the panel's pixels send there; `block_m` (zones, 2, 2) how far q moves with a
    block of `analyse`: d q_i for a block along axis j of the panel.
    """

    relief_m: Array
    relief_slope: Array
    envelope: Array
    block_m: Array


@dataclass(frozen=True)
class SpotArray:
    """The zones' spots on a nominal bench.

    `field_tan` (zones, 2) directions in P; `waves` their phase functions; `lit` (zones,) the share of the pupil's area
    that the panel lights; `centre_m` and `half_m` (zones, 2) the box round it; `flux` (zones,) what unit amplitude
    sends through the pupil, in pixels of the panel; `bend_per_m` (zones,) the defocus, k b |q - centre|^2 / 2;
    `amplitude` (zones,) 0 for a zone that is not lit; `pixels` (zones,) that a defocused spot covers.
    """

    facts: RigFacts
    wavelength_m: float
    field_tan: Array
    waves: SpotWaves
    lit: Array
    centre_m: Array
    half_m: Array
    flux: Array
    bend_per_m: Array
    amplitude: Array
    pixels: Array

    @cached_property
    def nearby(self) -> Nearby:
        """How directions near the spots' own differ from them."""
        radius_m = self.facts.pupil_diameter_m / 2
        return _nearby(nominal_bench(self.facts), self.waves, self.field_tan, self.wavelength_m, radius_m)

    @property
    def panel(self) -> Panel:
        """The panel's pixels."""
        return self.waves.panel

    @property
    def on(self) -> NDArray[np.bool_]:
        """Which zones are shown, (zones,)."""
        return np.asarray(self.amplitude > 0)

    @property
    def pixel_tan(self) -> float:
        """A camera pixel, in tangents."""
        camera = self.facts.camera
        return float(2 * np.tan(camera.field_rad[0] / 2) / camera.width)

    def places_px(self, field_tan: Array | None = None) -> Array:
        """Return where a rectilinear camera sees directions, (n, 2) column and row."""
        tangents, camera = self.field_tan if field_tan is None else field_tan, self.facts.camera
        return np.stack(
            [
                tangents[:, 0] / self.pixel_tan + (camera.width - 1) / 2,
                (camera.height - 1) / 2 - tangents[:, 1] / self.pixel_tan,
            ],
            axis=-1,
        )


@dataclass(frozen=True)
class Recipe:
    """What a frame shows: `defocus` in units of the array's own, `phase_rad` (zones,) of the spots, and a correction.

    `gain` (zones,) multiplies the array's amplitudes. `wavefront_rad` (zones, modes) of `noll` is added to each zone's
    phase over the whole pupil.
    """

    defocus: float
    phase_rad: Array
    gain: Array
    noll: tuple[int, ...] = ()
    wavefront_rad: Array | None = None


_MADE: OrderedDict[str, SpotArray] = OrderedDict()
_KEPT = 2


def spot_array(facts: RigFacts, wavelength_m: float, zones: int) -> SpotArray:
    """Return zones x zones spots over the camera's field, made for a rig's nominal bench; the last two are kept."""
    key = repr((facts, wavelength_m, zones))
    if key not in _MADE:
        _MADE[key] = spots_at(facts, wavelength_m, zone_directions(zones, facts.camera.field_rad))
        while len(_MADE) > _KEPT:
            _MADE.popitem(last=False)
    return _MADE[key]


def nominal_bench(facts: RigFacts) -> Bench:
    """Return the bench that a rig's drawing says."""
    return Bench.nominal(pupil_diameter_m=facts.pupil_diameter_m, eye_relief_m=facts.eye_relief_m)


def spots_at(facts: RigFacts, wavelength_m: float, field_tan: Array, bench: Bench | None = None) -> SpotArray:
    """Return spots in directions with tangents (n, 2), made for a bench, a rig's nominal one if none is given."""
    camera, bench = facts.camera, bench or nominal_bench(facts)
    panel = Panel(facts.slm.width, facts.slm.height, facts.slm.pitch_m)
    waves = spot_waves(bench, panel, VirtualPoints.at(field_tan), wavelength_m=wavelength_m)
    x, y = waves.block_grid(_BLOCK)
    pupil = waves.pupil.on_grid(x, y)
    passed = soft_disc(pupil, facts.pupil_diameter_m / 2, EDGE_M) ** 2
    count = len(field_tan)
    centre, half, area = np.zeros((count, 2)), np.full((count, 2), 1e-5), np.zeros(count)
    for zone in range(count):
        inside = passed[..., zone] > 0.1
        if np.count_nonzero(inside) < LEAST_COUNT:
            continue
        q = pupil[:, :, zone]
        low, high = q[inside].min(axis=0), q[inside].max(axis=0)
        centre[zone], half[zone] = (low + high) / 2, np.maximum((high - low) / 2, 1e-5)
        down, right = (np.asarray(np.gradient(q, axis=axis)) for axis in (0, 1))
        cell = np.abs(down[..., 0] * right[..., 1] - down[..., 1] * right[..., 0])
        area[zone] = float(np.sum(passed[..., zone] * cell))
    lit = area / (np.pi * (facts.pupil_diameter_m / 2) ** 2)
    # A pixel's area: light that leaves at another frequency than it came with is fainter by its sinc.
    flux = np.full(passed.shape, float(_BLOCK**2))
    for axis, own in zip((1, 0), panel.illumination_frequency_per_m, strict=True):
        flux *= np.sinc((derivative(waves.turns, axis).on_grid(x, y) - own) * panel.pitch_m) ** 2
    flux = np.sum(passed * flux, axis=(0, 1))
    pixel = 2 * np.tan(camera.field_rad[0] / 2) / camera.width
    bend = SPOT_PX / 2 * pixel / half.max(axis=1)
    widths = 2 * bend[:, None] * half / pixel + wavelength_m / (2 * half) / pixel + 1
    pixels = np.prod(np.minimum(widths, 60.0), axis=1)
    on = lit >= LEAST_LIT
    amplitude = np.where(on, np.sqrt(pixels / np.maximum(flux, 1.0)), 0.0)
    if on.any():
        amplitude = np.minimum(amplitude / amplitude[on].min(), MOST_BOOST)
    return SpotArray(
        facts, wavelength_m, field_tan, waves, lit, centre, half, flux, bend, np.asarray(amplitude), pixels
    )


def _nearby(bench: Bench, waves: SpotWaves, field_tan: Array, wavelength_m: float, radius_m: float) -> Nearby:
    panel, count, step = waves.panel, len(field_tan), 1e-3
    half = panel.half_size_m
    line = np.linspace(-1, 1, 25)
    x = np.stack(np.meshgrid(line * half[0], line * half[1]), axis=-1).reshape(-1, 2)
    sines = field_tan / np.sqrt(1 + np.sum(field_tan**2, axis=1, keepdims=True))

    def pupil(offset: Array) -> Array:
        moved = sines + offset
        tangent = moved / np.sqrt(1 - np.sum(moved**2, axis=1, keepdims=True))
        return exact_phase(bench, VirtualPoints.at(tangent), x[:, None], wavelength_m=wavelength_m).pupil_m

    q = pupil(np.zeros(2))
    by_s = np.stack([(pupil(step * e) - pupil(-step * e)) / (2 * step) for e in np.eye(2)], axis=-1)
    passed = soft_disc(q, radius_m, EDGE_M) ** 2
    frequency = np.stack([derivative(waves.turns, axis).at(x) for axis in (1, 0)], axis=-1)
    turns = (frequency - np.asarray(panel.illumination_frequency_per_m)) * panel.pitch_m
    relief, slope, envelope = np.zeros((count, 2, 2)), np.zeros((count, 2, 2, 2)), np.zeros((count, 2))
    block_m = np.zeros((count, 2, 2))
    for zone in range(count):
        away = np.linalg.norm(q[:, zone], axis=1)
        lit = np.argsort(away)[: max(np.count_nonzero(away < NEARBY_M), NEARBY_COUNT)]
        terms = np.concatenate([np.ones((len(lit), 1)), q[lit, zone]], axis=1)
        found = np.linalg.lstsq(terms, by_s[lit, zone].reshape(len(lit), 4), rcond=None)[0]
        relief[zone] = found[0].reshape(2, 2)
        slope[zone] = np.moveaxis(found[1:].reshape(2, 2, 2), 0, -1)
        # d f / d s = -(d q / d x)^T / wavelength: light turned by ds leaves the panel with another frequency.
        by_x = np.linalg.lstsq(np.concatenate([np.ones((len(lit), 1)), x[lit]], axis=1), q[lit, zone], rcond=None)[0]
        middle = np.average(turns[lit, zone], axis=0, weights=passed[lit, zone] + 1e-9)
        block_m[zone] = by_x[1:].T * BLOCK * panel.pitch_m
        envelope[zone] = -(_log_sinc_slope(middle) * panel.pitch_m @ by_x[1:]) / wavelength_m
    return Nearby(relief, slope, envelope, block_m)


def _log_sinc_slope(turns: Array) -> Array:
    """Return d ln sinc(u) / d u, u in turns over a pixel."""
    safe = np.where(np.abs(turns) < 1e-4, 1e-4, turns)
    return np.asarray(np.pi / np.tan(np.pi * safe) - 1 / safe)


def zone_directions(zones: int, field_rad: tuple[float, float]) -> Array:
    """Return the spots' tangents (zones^2, 2), from the top left; the same for every rig of this field."""
    rng = np.random.default_rng(20261)
    at = (2 * np.arange(zones) + 1 - zones) / zones
    half = np.tan(np.asarray(field_rad) / 2)
    grid = np.stack(np.meshgrid(at, at[::-1]), axis=-1).reshape(-1, 2)
    return np.asarray((grid + rng.uniform(-JITTER, JITTER, grid.shape) * 2 / zones) * half)


def soft_disc(pupil_m: Array, radius_m: float, edge_m: float) -> Array:
    """Return the transmission of a disc with a raised cosine for a rim, at points (..., 2)."""
    z = np.clip((radius_m - np.linalg.norm(pupil_m, axis=-1)) / edge_m, -0.5, 0.5)
    return np.asarray(0.5 + 0.5 * np.sin(np.pi * z))


def added_phase(array: SpotArray, recipe: Recipe, pupil_m: Array) -> Array:
    """Return what a recipe adds to the phase functions, (n, zones) radians, at pupil points (n, zones, 2)."""
    k, radius = 2 * np.pi / array.wavelength_m, array.facts.pupil_diameter_m / 2
    away = np.sum((pupil_m - array.centre_m) ** 2, axis=-1)
    phase = recipe.defocus * 0.5 * k * array.bend_per_m * away
    if recipe.wavefront_rad is not None and recipe.noll:
        basis = zernike(recipe.noll, pupil_m[..., 0] / radius, pupil_m[..., 1] / radius)
        phase = phase + np.einsum("jnz,zj->nz", basis, recipe.wavefront_rad)
    return np.asarray(phase)


def recipe_levels(
    array: SpotArray, recipe: Recipe, response_rad: Array, device: str = "cpu", *, only_pupil: bool = False
) -> Levels:
    """Return the levels that show a recipe: the phase of the sum of its waves, to the nearest level.

    The waves reach beyond the nominal pupil, so that they fill a bench's own wherever it lies; with `only_pupil` they
    end at its rim, as an image's do.
    """
    from holocal.hologram.frame import phase_to_levels

    waves = array.waves.with_phase(lambda q: added_phase(array, recipe, q))
    amplitude = array.amplitude * recipe.gain * np.exp(1j * recipe.phase_rad)
    radius = array.facts.pupil_diameter_m / 2
    window_m, soft_m = (radius, EDGE_M) if only_pupil else (radius + REACH_M - 1.7e-3, SOFT_M)

    def window(pupil_m: Array) -> Array:
        return soft_disc(pupil_m, window_m, soft_m)

    shown = synthesise(waves, amplitude, window, reach_m=window_m + soft_m / 2, device=device)
    carrier = 2 * np.pi * np.mod(array.panel.illumination_frequency_per_m[1] * array.panel.y_m, 1.0)
    phase = torch.angle(shown).cpu().numpy() - carrier[:, None].astype(np.float32)
    count = len(response_rad)
    nominal = np.array_equal(response_rad, np.arange(count) * (2 * np.pi / count))
    return phase_to_levels(phase, None if nominal and count == 256 else response_rad)


def light_of(array: SpotArray, levels: Levels, response_rad: Array, device: str = "cpu") -> torch.Tensor:
    """Return the field that levels send from the panel, (height, width) complex64, beam and pixels' shape apart."""
    carrier = 2 * np.pi * np.mod(array.panel.illumination_frequency_per_m[1] * array.panel.y_m, 1.0)
    of_level = np.exp(1j * np.asarray(response_rad)).astype(np.complex64)
    turned = torch.from_numpy(np.exp(1j * carrier).astype(np.complex64)).to(device)
    return torch.from_numpy(of_level[levels]).to(device).mul_(turned[:, None])


def seen_of(
    array: SpotArray, levels: Levels, recipe: Recipe, response_rad: Array, device: str = "cpu"
) -> list[tuple[Array, NDArray[np.complex64]]]:
    """Return for every zone what a frame's light holds of its spot: `analyse` of the levels shown.

    What the pixels' areas send of a spot's light, with the phase that the recipe adds, is in its values, less the slope
    over directions (`Nearby.envelope`), which is the picture's (`Window.envelope`).
    """
    sent = array.waves.with_phase(lambda q: added_phase(array, recipe, q))
    found = analyse(array.waves, light_of(array, levels, response_rad, device), reach_m=REACH_M, sent=sent)
    back = []
    for zone, (pupil, values) in enumerate(found):
        turn = -recipe.defocus * array.bend_per_m[zone] * (pupil - array.centre_m[zone])
        back.append((pupil, (values * np.exp(-turn @ array.nearby.envelope[zone])).astype(np.complex64)))
    return back


def expected_counts(array: SpotArray, seen: Sequence[tuple[Array, NDArray[np.complex64]]], rate: float) -> Array:
    """Return the counts per second, (zones,), that the pixels of every defocused spot get on average.

    `seen` is what the frame's light holds of the zones, `rate` the mean counts per second and pixel of a random
    pattern, whose every direction gets as many counts as pixels of the panel send light there.
    """
    radius = array.facts.pupil_diameter_m / 2
    unit = rate / max(float(np.mean(array.flux)), 1e-30)
    counts = np.zeros(len(array.field_tan))
    for zone in range(len(counts)):
        if not array.on[zone]:
            continue
        pupil, values = seen[zone]
        passed = soft_disc(pupil, radius, EDGE_M)
        blocks = float(np.sum(passed**2))
        if blocks < 1:
            continue
        cell = array.lit[zone] * np.pi * radius**2 / blocks  # of the pupil's area, per block
        light = float(np.sum(np.abs(values * passed) ** 2)) * (array.wavelength_m / array.pixel_tan) ** 2 / cell
        counts[zone] = unit * light / array.pixels[zone]
    return counts


def brighter_in_focus(array: SpotArray) -> float:
    """Return how many times brighter a sharp spot's pixels are than a defocused one's, the median zone."""
    sharp = np.prod(array.wavelength_m / (2 * array.half_m) / array.pixel_tan + 1, axis=1)
    return float(np.median((array.pixels / sharp)[array.on]))
