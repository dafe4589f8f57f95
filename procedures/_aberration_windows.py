"""The zones' spots as seen without a model of their pictures: windows, the lit part of each pupil, sharpness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from holocal.errors import RefusedError
from holocal.estimate.lit_pupil import LitPupil, mean_gradient
from holocal.loop.devices import Frame
from holocal.records.facts import RigFacts
from procedures._aberration_light import array_of, dark_level, levels_of, places_in
from procedures._aberration_seen import ZoneWindows
from procedures._aberration_spots import EDGE_M, Recipe, SpotArray, soft_disc

if TYPE_CHECKING:
    from procedures._aberration_model import State as Spots

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Levels = NDArray[np.uint8]

LARGEST_SIDE, SMALLEST_SIDE = 41, 21  # pixels of a window; a spot with the bias of a search is 17 wide
APART = 0.7  # of the zones' pitch, that spots are apart at least
MOST_POINTS = 3000  # of a lit part: a 4K panel has ten times as many blocks in it as its wavefront needs
FINE = 5  # samples of an ideal spot along a pixel
BOUND_SIDE = 17  # pixels of the square round a spot that its sharpness is measured in, at most


def window_side(facts: RigFacts, zones: int) -> int:
    """Return the pixels along a window's side, odd.

    Raises
    ------
    RefusedError
        The zones are too near to each other for windows that hold a spot each.
    """
    pitch = min(facts.camera.width, facts.camera.height) / zones
    side = min(LARGEST_SIDE, int(APART * pitch))
    side -= 1 - side % 2
    if side < SMALLEST_SIDE:
        raise RefusedError(
            f"{zones} x {zones} zones leave {side} camera pixels for each spot's window; it needs {SMALLEST_SIDE}.",
            fix=f"Use fewer zones: --set zones={max(2, int(APART * pitch * zones / (SMALLEST_SIDE + 1)))}.",
            measured=side,
            limit=SMALLEST_SIDE,
            code="zones-too-near",
        )
    return side


def zone_windows(spots: Spots) -> ZoneWindows:
    """Return the windows round the spots of the first frame.

    Raises
    ------
    RefusedError
        No zone has a window inside the picture, or `window_side`.
    """
    array, camera = array_of(spots), spots.facts.camera
    side = window_side(spots.facts, spots.parameters.zones)
    found = places_in(spots, 0)
    middle = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    jacobian = np.median(found.jacobian(array.places_px() - middle), axis=0)
    zones, places, reasons = [], [], []
    for zone, place in enumerate(found.seen):
        reason = _left_out(array, zone, place, side // 2)
        reasons.append(reason)
        if not reason:
            zones.append(zone)
            places.append([round(float(place[0])), round(float(place[1]))])
    if not zones:
        raise RefusedError(
            "no zone's spot has its window inside the camera's picture.",
            fix="Use more zones (--set zones=7), or a larger field of the camera.",
            code="no-zone-seen",
        )
    return ZoneWindows(
        np.array(zones, np.int64),
        np.array(places, np.int64).reshape(-1, 2),
        side,
        np.asarray(jacobian @ gradient_to_place(array)),
        tuple(reasons),
    )


def gradient_to_place(array: SpotArray) -> Array:
    """Return columns and rows, (2, 2), per radian per pupil radius of phase that a hologram adds.

    A delay that grows along +x turns light to -x: d sine = -gradient / (k radius); rows count downwards.
    """
    radius, k = array.facts.pupil_diameter_m / 2, 2 * np.pi / array.wavelength_m
    return np.diag([-1.0, 1.0]) / (k * radius * array.pixel_tan)


def _left_out(array: SpotArray, zone: int, place: Array, half: int) -> str:
    if not array.on[zone]:
        return f"the panel lights {array.lit[zone]:.1%} of the pupil: too little to measure"
    column, row = (round(float(v)) for v in place)
    camera = array.facts.camera
    if half <= column < camera.width - half and half <= row < camera.height - half:
        return ""
    return f"its spot is seen at column {column}, row {row}: its window is not all inside the picture"


def lit_pupils(array: SpotArray, zones: Sequence[int] | NDArray[np.int64]) -> list[LitPupil]:
    """Return the part of the nominal pupil that the panel lights in each of some zones."""
    block = max(4, -(-array.panel.width // 480))
    pupil, radius = array.waves.pupil.on_grid(*array.waves.block_grid(block)), array.facts.pupil_diameter_m / 2
    return [_lit_pupil(pupil[:, :, zone], radius) for zone in zones]


def _lit_pupil(q: Array, radius_m: float) -> LitPupil:
    cell = np.abs(np.linalg.det(np.stack([np.gradient(q, axis=0), np.gradient(q, axis=1)], axis=-1)))
    weight = soft_disc(q, radius_m, EDGE_M) ** 2 * cell
    step = max(1, int(np.sqrt(np.count_nonzero(weight) / MOST_POINTS)))
    q, weight = q[::step, ::step], weight[::step, ::step]
    points = q[weight > 0] / radius_m
    return LitPupil(points[:, 0], points[:, 1], weight[weight > 0])


def held_in_place(array: SpotArray, zones: NDArray[np.int64], noll: int) -> Array:
    """Return coefficients of Noll 2, 3 and `noll`, (n, 3): 1 rad of it and the tilt that holds a spot's centroid."""
    rows = []
    for lit in lit_pupils(array, zones):
        moved = mean_gradient(lit, (noll,))[:, 0]
        rows.append([-moved[0] / 2, -moved[1] / 2, 1.0])  # Noll 2 is 2 x, 3 is 2 y
    return np.array(rows).reshape(-1, 3)


def places_listed(windows: ZoneWindows, count: int) -> list[tuple[int, int] | None]:
    """Return the middle of each window, (column, row), for all zones of the field; None for those not looked at."""
    places: list[tuple[int, int] | None] = [None] * count
    for zone, (column, row) in zip(windows.zones, windows.places, strict=True):
        places[zone] = int(column), int(row)
    return places


def levels_with(spots: Spots, noll: tuple[int, ...], wavefront_rad: Array, seeds: tuple[int, int]) -> Levels:
    """Return the levels of spots in focus with (zones, len(noll)) radians added, phases drawn from (seed, *seeds)."""
    phase = np.random.default_rng([spots.seed, *seeds]).uniform(0, 2 * np.pi, spots.parameters.zones**2)
    return levels_of(spots, Recipe(0.0, phase, spots.next_gain, noll, wavefront_rad))


def cut(spots: Spots, windows: ZoneWindows, frame: Frame) -> tuple[Array, Mask]:
    """Return the windows of a frame, (n, side, side) counts less the dark level, and which pixels can be used."""
    return cut_picture(spots, windows, frame.counts, frame.exposure_s)


def cut_picture(
    spots: Spots, windows: ZoneWindows, picture: NDArray[np.uint16], exposure_s: float
) -> tuple[Array, Mask]:
    """Return the windows of a picture (height, width) as `cut` does."""
    half = windows.side // 2
    at = [(slice(r - half, r + half + 1), slice(c - half, c + half + 1)) for c, r in windows.places]
    usable = np.ones(picture.shape, np.bool_) if spots.reference is None else spots.reference.usable
    shape = (len(at), windows.side, windows.side)
    counts = np.array([picture[part] for part in at], np.float64).reshape(shape) - dark_level(spots, exposure_s)
    return counts, np.array([usable[part] for part in at], np.bool_).reshape(shape)


def brightest(spots: Spots, windows: Array, usable: Mask, *, pixels: int) -> Array:
    """Return how bright each spot is, (n,) shares of full scale: the mean of its best pixels, so many."""
    kept = np.where(usable, windows, 0.0).reshape(len(windows), -1)
    return np.asarray(np.sort(kept, axis=1)[:, -pixels:].mean(axis=1) / spots.facts.camera.full_scale)


def noise_of(spots: Spots) -> tuple[float, float]:
    """Return the camera's read variance, counts squared, and variance per count of light."""
    known = spots.reference
    return (1.0, spots.facts.camera.full_scale / 10_000) if known is None else (known.read_variance, known.gain)


def sharpness(spots: Spots, windows: ZoneWindows, counts: Array, usable: Mask, lit: Sequence[LitPupil]) -> Array:
    """Return how concentrated each spot is, (n,): 1 is what the lit part of the nominal pupil gives unaberrated.

    The sum of squares over the square of the sum of the pixels round the spot, noise taken out, over that of a perfect
    spot at the same place between the pixels; NaN where there is no light. An aberration of rms s leaves about
    exp(-s^2) of it where pixels are finer than the spot, more where they are coarser.
    """
    read, gain = noise_of(spots)
    out = np.full(len(counts), np.nan)
    for zone, (window, good) in enumerate(zip(counts, usable, strict=True)):
        light = np.where(good, window - _level(window, good), 0.0)
        part = _round_brightest(light)
        total = float(light[part].sum())
        variance = read + gain * np.maximum(window[part], 0.0)
        if total <= 8 * float(np.sqrt(variance.sum())):
            continue
        concentrated = float(np.sum((light[part] ** 2 - variance)[good[part]])) / total**2
        out[zone] = concentrated / ideal_concentration(spots, windows, lit[zone], _offset(light[part]))
    return out


def _level(window: Array, good: Mask) -> float:
    """Return the mean of the pixels along a window's border: a median would be a whole count."""
    border = good.copy()
    border[2:-2, 2:-2] = False
    return float(window[border].mean()) if border.any() else 0.0


def _round_brightest(light: Array) -> tuple[slice, slice]:
    side = min(BOUND_SIDE, len(light))
    low = [
        int(np.clip(at - side // 2, 0, len(light) - side)) for at in np.unravel_index(int(light.argmax()), light.shape)
    ]
    return slice(low[0], low[0] + side), slice(low[1], low[1] + side)


def _offset(light: Array) -> Array:
    """Return where a spot lies in its brightest pixel, (column, row) from -0.5 to 0.5."""
    row, column = (int(i) for i in np.unravel_index(int(light.argmax()), light.shape))
    part = np.maximum(light[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2], 0.0)
    if part.shape != (3, 3):
        return np.zeros(2)
    step = np.arange(-1, 2)
    moved = np.array([part.sum(axis=0) @ step, part.sum(axis=1) @ step]) / part.sum()
    return np.asarray(np.clip(moved, -0.5, 0.5))


def ideal_concentration(spots: Spots, windows: ZoneWindows, lit: LitPupil, offset_px: Array) -> float:
    """Return the sum of squares over the squared sum of a perfect spot's pixels, `offset_px` off a pixel's middle.

    |sum of exp(i k q . s) over the lit part|^2 at `FINE`^2 directions s in each pixel.
    """
    per_px = np.linalg.inv(windows.px_per_gradient)  # radians per radius that move the spot by a pixel
    size = min(BOUND_SIDE, windows.side)
    at = (np.arange(size * FINE) - (size * FINE - 1) / 2) / FINE
    slope = np.stack([lit.x, lit.y], axis=1) @ per_px  # (points, 2): phase per column and row
    across = np.exp(1j * np.outer(at - offset_px[0], slope[:, 0])) * lit.share
    down = np.exp(1j * np.outer(at - offset_px[1], slope[:, 1]))
    fine = np.abs(down @ across.T) ** 2
    pixels = fine.reshape(size, FINE, size, FINE).sum(axis=(1, 3))
    return float(np.sum(pixels**2) / np.sum(pixels) ** 2)
