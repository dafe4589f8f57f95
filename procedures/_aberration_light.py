"""What the aberration's frames are shown with: recipes, levels, exposures, and how brightness is shared out."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from hashlib import sha256
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from holocal.errors import RefusedError
from holocal.estimate.field_model import field_terms
from holocal.estimate.spot_model import Seen
from holocal.estimate.spot_places import SpotPlaces, find_spots
from holocal.loop.devices import Frame
from holocal.loop.reference import Reference
from procedures._aberration_spots import (
    MOST_BOOST,
    Levels,
    Recipe,
    SpotArray,
    brighter_in_focus,
    expected_counts,
    recipe_levels,
    seen_of,
    spot_array,
)

if TYPE_CHECKING:
    from procedures._aberration_model import State

Array = NDArray[np.float64]

_KEPT = 8  # frames whose levels and light are kept: 8 MB and some tens of MB each at 4K
_LEVELS: OrderedDict[str, Levels] = OrderedDict()
_SEEN: OrderedDict[str, list[Seen]] = OrderedDict()
FEWEST_SPOTS = 2
LEAST_SHARE = 0.25  # of the picture's light, that lies in the spots found: 0.6 to 0.8 on the simulated benches
SPOT_REACH_PX = 14


def array_of(state: State) -> SpotArray:
    """Return the spots that the state's rig and parameters ask for."""
    chosen = state.parameters
    return spot_array(state.facts, chosen.wavelength_nm * 1e-9, chosen.zones)


def half_tan_of(state: State) -> tuple[float, float]:
    """Return the half width of the field in tangents."""
    half = np.tan(np.asarray(state.facts.camera.field_rad) / 2)
    return float(half[0]), float(half[1])


def correction_of(state: State) -> Array:
    """Return the correction in force, (zones, modes) radians to add: what the field's model says, turned round."""
    modes, zones = len(state.parameters.noll), state.parameters.zones**2
    if state.coefficients_rad.shape[1] == 0:
        return np.zeros((zones, modes))
    return np.asarray(-field_terms(array_of(state).field_tan, half_tan_of(state)) @ state.coefficients_rad.T)


def recipe_of(state: State, defocus: float, seeds: tuple[int, int]) -> Recipe:
    """Return what a frame shows under the state's correction, phases drawn from (seed, step, shot)."""
    return _recipe(state, defocus, seeds, state.next_gain, correction_of(state))


def recipe_taken(state: State, frame: int) -> Recipe:
    """Return what a frame of the state was shown with."""
    seeds = (int(state.seeds[frame, 0]), int(state.seeds[frame, 1]))
    return _recipe(state, float(state.defocus[frame]), seeds, state.gains[frame], state.corrections_rad[frame])


def _recipe(state: State, defocus: float, seeds: tuple[int, int], gain: Array, correction: Array) -> Recipe:
    rng = np.random.default_rng([state.seed, *seeds])
    phase = rng.uniform(0, 2 * np.pi, state.parameters.zones**2)
    return Recipe(defocus, phase, gain, state.parameters.noll, correction if correction.any() else None)


def levels_of(state: State, recipe: Recipe) -> Levels:
    """Return the levels of a recipe; those of the last few are kept."""
    key = _key(state, recipe)
    if key not in _LEVELS:
        _LEVELS[key] = recipe_levels(array_of(state), recipe, state.response_rad, state.parameters.device)
        while len(_LEVELS) > _KEPT:
            _LEVELS.popitem(last=False)
    return _LEVELS[key]


def seen_in(state: State, recipe: Recipe) -> list[Seen]:
    """Return what the light of a recipe's levels holds of every zone; that of the last few is kept."""
    key = _key(state, recipe)
    if key not in _SEEN:
        levels = levels_of(state, recipe)
        _SEEN[key] = seen_of(array_of(state), levels, recipe, state.response_rad, state.parameters.device)
        while len(_SEEN) > _KEPT:
            _SEEN.popitem(last=False)
    return _SEEN[key]


def _key(state: State, recipe: Recipe) -> str:
    parts = [repr((state.facts, state.parameters, recipe.defocus, recipe.noll)).encode()]
    parts += [np.ascontiguousarray(part).tobytes() for part in (recipe.phase_rad, recipe.gain, state.response_rad)]
    parts.append(b"" if recipe.wavefront_rad is None else np.ascontiguousarray(recipe.wavefront_rad).tobytes())
    return sha256(b"|".join(parts)).hexdigest()


def dark_level(state: State, exposure_s: float) -> float:
    """Return the counts without light."""
    return 0.0 if state.reference is None else state.reference.dark_level(exposure_s)


def told(state: State, reference: Reference) -> State:
    """Return the state with the first frame's gains and exposure, from the light that a random pattern sent.

    The phase of a sum of waves gives each another share of the light than its amplitude squared: the first guess at
    equal brightness is corrected once, on the levels themselves.
    """
    from procedures._aberration_model import FIRST_PEAK, PEAK_OVER_MEAN

    camera, array = state.facts.camera, array_of(state)
    state = replace(state, reference=reference)
    if not array.on.any():
        return state
    rate = max(reference.rate, 1e-9)
    counts = expected_counts(array, seen_in(state, recipe_of(state, 1.0, (0, 0))), rate)
    typical = float(np.median(counts[array.on]))
    gain = np.clip(np.sqrt(typical / np.maximum(counts, 1e-9 * typical)), 1 / 3, 3.0)
    state = replace(state, next_gain=np.where(array.on, gain, 1.0))
    counts = expected_counts(array, seen_in(state, recipe_of(state, 1.0, (0, 0))), rate)
    wanted = FIRST_PEAK * camera.full_scale / (PEAK_OVER_MEAN * max(float(counts.max()), 1e-9))
    return replace(state, guess_s=float(np.clip(wanted, camera.exposure_min_s, camera.exposure_max_s)))


def window_peaks(state: State, places: SpotPlaces, picture: Array) -> Array:
    """Return the brightness of every zone's brightest pixels, (zones,) counts above the dark level; 0 if not seen."""
    array, camera = array_of(state), state.facts.camera
    peaks = np.zeros(len(array.field_tan))
    for zone in np.flatnonzero(array.on):
        column, row = (round(float(v)) for v in places.seen[zone])
        reach = SPOT_REACH_PX
        part = picture[
            max(row - reach, 0) : max(row + reach + 1, 0), max(column - reach, 0) : max(column + reach + 1, 0)
        ]
        if part.size and 0 <= column < camera.width and 0 <= row < camera.height:
            peaks[zone] = float(np.quantile(part, 1 - min(8.0 / part.size, 0.5)))
    return peaks


def light_in_spots(places: SpotPlaces, picture: Array) -> float:
    """Return the share of a picture's light that lies round the spots that were found; 0 where there is no light."""
    inside = np.zeros(picture.shape, np.bool_)
    for column, row in places.seen[places.used]:
        c, r = round(float(column)), round(float(row))
        low = max(r - SPOT_REACH_PX, 0), max(c - SPOT_REACH_PX, 0)
        inside[low[0] : max(r + SPOT_REACH_PX + 1, 0), low[1] : max(c + SPOT_REACH_PX + 1, 0)] = True
    total = float(picture.sum())
    return float(picture[inside].sum()) / total if total > 0 else 0.0


def places_in(state: State, frame: int) -> SpotPlaces:
    """Return where the spots of one of the state's frames are seen."""
    array = array_of(state)
    picture = state.pictures[frame].astype(np.float64) - dark_level(state, float(state.exposures_s[frame]))
    if state.reference is not None:
        picture = np.where(state.reference.usable, picture, 0.0)
    light = np.where(array.on, (array.amplitude * state.gains[frame]) ** 2 * array.flux, 0.0)
    return find_spots(picture, array.places_px(), light, 5.0)


def with_first(state: State, frame: Frame) -> State:
    """Return the state with the first frame and the exposure it leads to, or with the next guess."""
    from procedures._aberration_model import CLIPPED, FAINT, SEARCHES, WANTED_PEAK, taken

    camera, array = state.facts.camera, array_of(state)
    if not array.on.any():
        raise RefusedError(
            f"the panel lights no zone of {state.parameters.zones} x {state.parameters.zones} through the pupil.",
            fix="Use more zones (--set zones=7), or a smaller field of the camera.",
            code="no-zone-lit",
        )
    tried = taken(replace(state, searched=state.searched + 1, step=state.step + 1), frame, 1.0, (state.step, 0))
    places = places_in(tried, len(tried.pictures) - 1)
    picture = frame.counts.astype(np.float64) - dark_level(state, frame.exposure_s)
    if state.reference is not None:
        picture = np.where(state.reference.usable, picture, 0.0)
    peaks = window_peaks(tried, places, picture)
    brightest, last = float(peaks.max()), tried.searched >= SEARCHES
    lit_pixels = float(np.sum(array.pixels[array.on]))
    clipped = frame.saturated_fraction * camera.width * camera.height > CLIPPED * lit_pixels * 4
    faint = brightest < FAINT * camera.full_scale and frame.exposure_s < 0.99 * camera.exposure_max_s
    if (clipped or faint) and not last:
        factor = 0.25 if clipped else min(20.0, 0.5 * camera.full_scale / max(brightest, 2.0))
        guess = float(np.clip(frame.exposure_s * factor, camera.exposure_min_s, camera.exposure_max_s))
        if guess != frame.exposure_s:
            return replace(state, searched=tried.searched, step=tried.step, guess_s=guess)
    share = light_in_spots(places, picture)
    if np.count_nonzero(places.used) < FEWEST_SPOTS or not share >= LEAST_SHARE:
        raise RefusedError(
            f"{np.count_nonzero(places.used)} of {int(array.on.sum())} spots were found in the camera's picture, with "
            f"{share:.0%} of its light; the limits are {FEWEST_SPOTS} and {LEAST_SHARE:.0%}.",
            why="Without them no zone can be told from another.",
            fix="Check that the camera sees the field, and that its picture is neither mirrored nor turned far.",
            measured={"spots": int(np.count_nonzero(places.used)), "share": share},
            limit={"spots": FEWEST_SPOTS, "share": LEAST_SHARE},
            code="no-spots",
        )
    seen = array.on & (peaks > 0.02 * brightest)
    wanted = np.where(seen, np.sqrt(np.median(peaks[seen]) / np.maximum(peaks, 1e-9)), 1.0)
    gain = np.clip(wanted, 1 / 3, 3.0) * state.next_gain
    shared = array.amplitude * gain
    most = MOST_BOOST * float(shared[array.on].min())
    gain = np.where(array.on, np.minimum(shared, most) / np.maximum(array.amplitude, 1e-9), 1.0)
    # Amplitudes that grow take light from the others: the sum of their squares is what the panel has.
    before, after = (float(np.sum((array.amplitude * g) ** 2)) for g in (state.next_gain, gain))
    expected = peaks * (gain / state.next_gain) ** 2 * before / after
    exposure_s = frame.exposure_s * WANTED_PEAK * camera.full_scale / max(float(expected[seen].max()), 1.0)
    return replace(
        tried,
        next_gain=gain,
        exposure_s=float(np.clip(exposure_s, camera.exposure_min_s, camera.exposure_max_s)),
    )


def shot_exposure_s(state: State, defocus: float) -> float:
    """Return the exposure of a frame: one in focus is brighter."""
    camera, array = state.facts.camera, array_of(state)
    if defocus != 0:
        return state.exposure_s
    brighter = brighter_in_focus(array)
    # An aberration spreads light as a defocus does; corrected spots are sharp.
    unsharp = 1.0 if state.coefficients_rad.shape[1] else 3.0
    return float(np.clip(state.exposure_s * unsharp / brighter, camera.exposure_min_s, camera.exposure_max_s))
