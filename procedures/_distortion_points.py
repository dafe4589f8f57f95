"""The distortion's spots: what is shown, how bright it will be, and where the camera sees it, with a variance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from holocal.estimate.camera_lens import ideal_pixels, seen_pixels, seen_tangents
from holocal.estimate.spot_pattern import recognise, require_recognised
from holocal.estimate.spot_places import find_spots
from holocal.loop.reference import Reference
from holocal.records.facts import CameraFacts
from procedures._aberration_spots import EDGE_M, Recipe, SpotArray, soft_disc

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SPREAD = 0.3  # of the defocus that `spot_array` gives a spot: 6 pixels wide, whatever its pupil
COARSE = 32  # pixels of the panel: how finely the light's shares are foreseen
PEAK_OVER_MEAN = 2.2  # of a defocused spot
ROUNDS, MOST_BOOST = 5, 4.0  # of the sharing of brightness; amplitude over the median spot's
COHERENT = 0.78  # pi / 4: what the phase of a sum of many waves keeps of each, of its share of the light
LEAST_LIT = 0.04  # of the pupil: spots with 2 % were seen up to 0.7 px from where exact rays have them, with 1 % 1.3 px
WIDEST_BLUR_PX = 4.0  # half of what diffraction at the pupil's lit part makes of a spot: its tails have no middle
MARGIN_PX = 4  # of a window round a spot: what an aberration of 2 rad throws out; more lets in other light
SIGMA_PX = 4.0
BLURS_PX = (4.0, 8.0)  # of the pattern that is looked for: a bench far out bends the picture by more than a spot
FAINTEST_SIGMAS, FAINTEST_SHARE = 8.0, 0.01  # of a spot's light: over its noise, and of the median spot's
WORST_PX = 0.2  # of a centroid's error: above, the spot is not seen
WORSE, WORSE_PX = 2.0, 0.09  # or above both, times the median's: strips of a pupil, up to 0.7 px from exact rays
CROSSTALK_PX = 0.03  # of a centroid: what the encoding leaves of the other spots' light in a window
LARGEST_SPLIT_PX = 25.0  # between the two defoci of a spot


@dataclass(frozen=True)
class Places:
    """Where n spots are seen: `ideal_px` (n, 2) as a camera without a geometry of its own would see them, `sigma_px`
    (n,) of each coordinate, `found` (n,). `camera_px` (n, 2) are places in the picture itself, `either_px` (2, n, 2)
    those of `ideal_px` in the two pictures of opposite defocus."""

    ideal_px: Array
    camera_px: Array
    sigma_px: Array
    found: Mask
    either_px: Array


def recipe(array: SpotArray, sign: float, seeds: Sequence[int]) -> Recipe:
    """Return what a frame shows: all spots, of one defocus, their phases drawn from the seeds."""
    count = len(array.field_tan)
    phase = np.random.default_rng(list(seeds)).uniform(0, 2 * np.pi, count)
    return Recipe(sign * SPREAD, phase, np.ones(count))


def spot_pixels(array: SpotArray) -> Array:
    """Return half the width of every spot along x and y, (n, 2) pixels, at the distortion's defocus."""
    extent = SPREAD * array.bend_per_m[:, None] * array.half_m / array.pixel_tan
    return np.asarray(extent + 0.5 * np.minimum(array.wavelength_m / (2 * array.half_m) / array.pixel_tan, 12.0) + 0.5)


def light_foreseen(array: SpotArray, rate: float) -> Array:
    """Return the counts per second (n,) of every spot, from the `rate` per pixel of a random pattern.

    Of the waves that meet at a place of the panel each keeps pi / 4 of its share of their intensities. A random pattern
    sends the light of every pixel to every direction alike.
    """
    x, y = array.waves.block_grid(COARSE)
    pupil = array.waves.pupil.on_grid(x, y)
    passed = soft_disc(pupil, array.facts.pupil_diameter_m / 2, EDGE_M) ** 2
    strength = passed * array.amplitude**2
    share = COHERENT * strength / np.maximum(strength.sum(axis=-1, keepdims=True), 1e-30)
    per_pixel = share * passed * COARSE**2
    covered = np.maximum(np.sum(passed, axis=(0, 1)) * COARSE**2, 1.0)  # pixels of the panel
    area = np.maximum(array.lit, 1e-6) * np.pi * (array.facts.pupil_diameter_m / 2) ** 2
    unit = rate / max(float(np.mean(array.flux)), 1e-30)
    solid = (array.wavelength_m / array.pixel_tan) ** 2
    return np.asarray(unit * per_pixel.sum(axis=(0, 1)) * solid * covered / area)


def peaks_foreseen(array: SpotArray, rate: float) -> Array:
    """Return the counts per second (n,) of every spot's brightest pixels."""
    pixels = np.prod(2 * spot_pixels(array), axis=1)
    return np.asarray(PEAK_OVER_MEAN * light_foreseen(array, rate) / pixels)


def evenly_bright(array: SpotArray) -> SpotArray:
    """Return the array with amplitudes that make all spots as bright, as far as the panel's light goes.

    A spot of whose pupil the panel lights but a strip is blurred to one side: it is left dark.
    """
    blur_px = array.wavelength_m / (2 * array.half_m.min(axis=1)) / array.pixel_tan
    strip = (array.lit < LEAST_LIT) | (blur_px > WIDEST_BLUR_PX)
    array = replace(array, amplitude=np.where(strip, 0.0, array.amplitude))
    on = array.on
    for _ in range(ROUNDS if on.any() else 0):
        peaks = peaks_foreseen(array, 1.0)
        typical = float(np.median(peaks[on]))
        amplitude = array.amplitude * np.sqrt(typical / np.maximum(peaks, 1e-3 * typical))
        amplitude = np.where(on, amplitude, 0.0)
        array = replace(array, amplitude=np.minimum(amplitude, MOST_BOOST * float(np.median(amplitude[on]))))
    return array


def dark_subtracted(counts: NDArray[np.generic], reference: Reference | None, exposure_s: float) -> Array:
    """Return a picture less its dark level; hot pixels take the median of those around."""
    picture = counts.astype(np.float32)
    if reference is None:
        return picture.astype(np.float64)
    picture -= np.float32(reference.dark_level(exposure_s))
    if not reference.usable.all():
        picture = np.where(reference.usable, picture, cv2.medianBlur(picture, 3))
    return picture.astype(np.float64)


def places_of_pair(
    array: SpotArray,
    pair: Sequence[NDArray[np.generic]],
    exposures_s: Sequence[float],
    reference: Reference | None,
    *,
    wanted_tan: Array | None = None,
) -> Places:
    """Return where spots are seen, from two pictures of opposite defocus.

    A defocused spot is the image of its pupil, whose middle is not known; the mean of both is where it is in focus, for
    light that the pupil's rim or the panel's edge cuts too. `wanted_tan` (n, 2) is where spots are expected; left out,
    in the directions sent.

    Raises
    ------
    RefusedError
        The pictures do not show these spots, upright.
    """
    camera = array.facts.camera
    expected = seen_pixels(array.field_tan if wanted_tan is None else wanted_tan, camera)
    pictures = [dark_subtracted(one, reference, s) for one, s in zip(pair, exposures_s, strict=True)]
    light = np.where(array.on, array.amplitude**2 * array.flux, 0.0)
    both, even = pictures[0] + pictures[1], np.ones(int(array.on.sum()))  # they were made as bright
    tried = [
        recognise(both, expected[array.on], even, sigma_px=radius, apart_px=_pitch_px(array) / 2) for radius in BLURS_PX
    ]
    require_recognised(max(tried, key=lambda one: one.match / max(one.rival, 1e-9)))
    reach = spot_pixels(array) + MARGIN_PX
    found = np.ones(len(light), np.bool_)
    centre, variance = [], []
    for picture, exposure_s in zip(pictures, exposures_s, strict=True):
        near = find_spots(picture, expected, light, SIGMA_PX)
        at, sigma, sure = _centroids(picture, near.at(near.places) + near.middle, reach, _noise(reference, exposure_s))
        centre.append(at)
        variance.append(sigma**2)
        found &= sure
    split = np.linalg.norm(centre[0] - centre[1], axis=1)
    found &= array.on & (split <= LARGEST_SPLIT_PX)
    mean = (centre[0] + centre[1]) / 2
    sigma = np.sqrt((variance[0] + variance[1]) / 4 + CROSSTALK_PX**2)
    if found.any():
        found &= sigma <= max(WORSE_PX, WORSE * float(np.median(sigma[found])))
    either = np.stack([ideal_pixels(seen_tangents(one, camera), camera) for one in centre])
    return Places(either.mean(axis=0), mean, sigma, found, either)


def _pitch_px(array: SpotArray) -> float:
    camera = array.facts.camera
    return camera.width / float(np.sqrt(len(array.field_tan)))


def _noise(reference: Reference | None, exposure_s: float) -> tuple[float, float]:
    return (1.0, 1.0) if reference is None else (reference.read_variance, reference.gain)


def _centroids(picture: Array, near: Array, reach: Array, noise: tuple[float, float]) -> tuple[Array, Array, Mask]:
    """Return centroids (n, 2), their errors (n,) per coordinate, and which are to be believed (n,)."""
    height, width = picture.shape
    out, sigma, light, doubt = near.copy(), np.full(len(near), np.inf), np.zeros(len(near)), np.full(len(near), np.inf)
    for i in range(len(near)):
        half = np.ceil(reach[i]).astype(int)
        for _ in range(3):
            column, row = (round(float(v)) for v in out[i])
            inside = half[0] <= column < width - half[0] and half[1] <= row < height - half[1]
            if not inside:
                light[i] = 0.0
                break
            cut = picture[row - half[1] : row + half[1] + 1, column - half[0] : column + half[0] + 1]
            y, x = np.mgrid[-half[1] : half[1] + 1, -half[0] : half[0] + 1]
            rim = (np.abs(x) >= half[0] - 1) | (np.abs(y) >= half[1] - 1)
            signal = np.where(rim, 0.0, cut - np.median(cut[rim]))
            total = float(signal.sum())
            if total <= 0:
                light[i] = 0.0
                break
            dx, dy = float((signal * x).sum() / total), float((signal * y).sum() / total)
            out[i] = column + dx, row + dy
            # what the encoding leaves of other spots' light is seen round the spot, and lies under it too
            variance = noise[0] + noise[1] * np.maximum(cut, 0.0) + float(np.var(cut[rim]))
            spread = variance * ((x - dx) ** 2 + (y - dy) ** 2) / 2
            sigma[i] = np.sqrt(float(spread[~rim].sum())) / total
            light[i], doubt[i] = total, np.sqrt(float(variance[~rim].sum()))
    typical = float(np.median(light[light > 0])) if np.any(light > 0) else 0.0
    sure = (light > FAINTEST_SIGMAS * doubt) & (light > FAINTEST_SHARE * typical) & (sigma <= WORST_PX)
    return out, sigma, sure


def in_the_picture(tangents: Array, camera: CameraFacts, margin_px: float) -> Mask:
    """Return which tangents (n, 2) the camera sees, (n,), away from the edge of its picture."""
    at = seen_pixels(tangents, camera)
    size = np.array([camera.width, camera.height])
    return np.asarray(np.all((at >= margin_px) & (at <= size - 1 - margin_px), axis=1))
