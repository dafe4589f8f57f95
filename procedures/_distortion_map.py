"""From the distortion's frames to the map: exposure, places, fit, and what the verification sends."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from holocal.errors import RefusedError
from holocal.estimate.camera_lens import ideal_pixels, ideal_tangents
from holocal.estimate.map_fit import fit_smooth_map
from holocal.estimate.picture_map import FourCorners, outermost
from holocal.estimate.smooth_map import SmoothMap
from holocal.loop.devices import Frame
from procedures._aberration_spots import SpotArray, recipe_levels, spots_at, zone_directions
from procedures._bench_light import ArrayLight, SpotData, array_light, fit_light, moved_px, spot_data
from procedures._distortion_points import (
    Places,
    evenly_bright,
    in_the_picture,
    peaks_foreseen,
    places_of_pair,
    recipe,
    spot_pixels,
)

if TYPE_CHECKING:
    from procedures.distortion import State

Array = NDArray[np.float64]

FEWEST = 12  # spots that make a map
ROUGHEST_PX = 1.0  # of a map, at spots held out: a bench's own leaves below 0.1
EDGE_PX = 4.0  # of the picture: a spot nearer is not asked for
_MADE: OrderedDict[str, SpotArray] = OrderedDict()
_KEPT = 3
_MEASURED: dict[str, list[Places]] = {}


def array_of(state: State, grid: int) -> SpotArray:
    """Return the spots of a grid: 0 and 1 are measured, 2 verifies; the last three are kept."""
    chosen, camera = state.parameters, state.facts.camera
    tangents = (zone_directions(chosen.points, camera.field_rad), state.second_tan, state.sent_tan)[grid]
    key = repr((state.facts, chosen.wavelength_nm, tangents.tobytes()))
    if key not in _MADE:
        _MADE[key] = evenly_bright(spots_at(state.facts, chosen.wavelength_nm * 1e-9, tangents))
        while len(_MADE) > _KEPT:
            _MADE.popitem(last=False)
    return _MADE[key]


def levels_of(state: State, grid: int, sign: float, seeds: Sequence[int]) -> NDArray[np.uint8]:
    """Return the levels that show a grid with a defocus of this sign."""
    array = array_of(state, grid)
    if not array.on.any():
        raise RefusedError(
            "the panel lights no spot of the field through the pupil.",
            fix="Use a smaller field of the camera, or a larger pupil.",
            code="no-spot-lit",
        )
    shown = recipe(array, sign, seeds)
    return recipe_levels(array, shown, state.response_rad, state.parameters.device, only_pupil=True)


def first_guess_s(state: State, rate: float) -> float:
    """Return the first frame's exposure from the light of a random pattern, counts per second and pixel."""
    from procedures.distortion import FIRST_PEAK

    camera, array = state.facts.camera, array_of(state, 0)
    if not array.on.any():
        return state.guess_s
    peak = float(np.median(peaks_foreseen(array, max(rate, 1e-9))[array.on]))
    guess = FIRST_PEAK * camera.full_scale / max(peak, 1e-9)
    return float(np.clip(guess, camera.exposure_min_s, camera.exposure_max_s))


def with_first(state: State, frame: Frame) -> State:
    """Return the state with the first frame and the exposure of the others, or with the next guess."""
    from procedures.distortion import CLIPPED, FAINT, SEARCHES, WANTED_PEAK, with_frames

    camera = state.facts.camera
    dark = 0.0 if state.reference is None else state.reference.dark_level(frame.exposure_s)
    usable = np.ones(frame.counts.shape, np.bool_) if state.reference is None else state.reference.usable
    values = np.where(usable, frame.counts, 0)
    spot = float(np.median(np.prod(2 * spot_pixels(array_of(state, 0)), axis=1)))
    # the brightest spot's mean, whatever a few bright pixels of it are
    brightest = float(np.quantile(values, 1 - min(0.5 * spot / values.size, 0.01))) - dark
    clipped = frame.saturated_fraction > CLIPPED
    faint = brightest < FAINT * camera.full_scale and frame.exposure_s < 0.99 * camera.exposure_max_s
    searched = state.searched + 1
    if (clipped or faint) and searched < SEARCHES:
        factor = 0.2 if clipped else min(20.0, WANTED_PEAK * camera.full_scale / max(brightest, 2.0))
        guess = float(np.clip(frame.exposure_s * factor, camera.exposure_min_s, camera.exposure_max_s))
        if guess != frame.exposure_s:
            return replace(state, guess_s=guess, searched=searched)
    wanted = frame.exposure_s * WANTED_PEAK * camera.full_scale / max(brightest, 1.0)
    exposure_s = float(np.clip(wanted, camera.exposure_min_s, camera.exposure_max_s))
    return with_frames(replace(state, searched=searched, exposure_s=exposure_s), [frame], [0])


def measured(state: State) -> tuple[Array, Places]:
    """Return where the measured spots were sent and where a picture's points would be seen, of all grids together."""
    grids = _places_of_grids(state)
    places = [moved(state, grid, own) for grid, own in enumerate(grids)]
    sent = [ideal_pixels(array_of(state, grid).field_tan, state.facts.camera) for grid in range(len(grids))]
    return np.concatenate(sent), Places(
        np.concatenate([one.ideal_px for one in places]),
        np.concatenate([one.camera_px for one in places]),
        np.concatenate([one.sigma_px for one in places]),
        np.concatenate([one.found for one in places]),
        np.concatenate([one.either_px for one in places], axis=1),
    )


def _places_of_grids(state: State) -> list[Places]:
    """Return where the camera sees the spots of every grid that was measured; the last are kept, as several ask."""
    said = (state.facts, state.parameters, state.exposures_s.tolist(), state.grids.tolist(), state.second_tan.tolist())
    key = sha256(repr(said).encode())
    key.update(np.ascontiguousarray(state.pictures).tobytes())
    if key.hexdigest() not in _MEASURED:
        _MEASURED.clear()
        _MEASURED[key.hexdigest()] = _seen_in_grids(state)
    return _MEASURED[key.hexdigest()]


def _seen_in_grids(state: State) -> list[Places]:
    pairs = [np.flatnonzero(state.grids == grid) for grid in range(int(state.grids.max()) + 1)]
    return [
        places_of_pair(
            array_of(state, grid),
            list(state.pictures[pair]),
            state.exposures_s[pair].tolist(),
            state.reference,
            wanted_tan=_second_wanted(state) if grid == 1 else None,
        )
        for grid, pair in enumerate(pairs)
    ]


def _second_wanted(state: State) -> Array:
    return zone_directions(state.parameters.points + 1, state.facts.camera.field_rad)


def with_second_grid(state: State) -> State:
    """Return the state with where the second grid is sent, so that it is seen all over the camera's picture.

    A bench far out of line moves the picture by a tenth of its width: what is to be seen at one side is sent from
    beyond it. The first grid's homography says where from, to a few pixels.
    """
    camera = state.facts.camera
    (places,) = _places_of_grids(state)
    sent = ideal_pixels(array_of(state, 0).field_tan, camera)
    wanted = _second_wanted(state)
    if np.count_nonzero(places.found) < FEWEST:
        return replace(state, second_tan=wanted)
    fitted = fit_smooth_map(sent[places.found], places.ideal_px[places.found], sigma_px=places.sigma_px[places.found])
    back, _ = FourCorners(fitted.homography).inverse(ideal_pixels(wanted, camera))
    return replace(state, second_tan=ideal_tangents(back, camera))


def moved(state: State, grid: int, places: Places) -> Places:
    """Return a grid's places with the spots moved to where a picture's points are seen (`procedures._bench_light`)."""
    if not len(state.light_values):
        return places
    return replace(places, ideal_px=places.ideal_px + moved_px(_light_of(state, grid), state.light_values))


def with_light(state: State) -> State:
    """Return the state with the beam and the bench that explain the spots of all grids that were measured."""
    data = spots_seen(state)
    if np.count_nonzero(np.isfinite(data.middles_px)) < 4 * FEWEST:
        return state
    return replace(state, light_values=fit_light(data).values)


def spots_seen(state: State) -> SpotData:
    """Return the middles of the spots of all grids that were measured, in either picture of opposite defocus."""
    grids = _places_of_grids(state)
    return spot_data(
        [_light_of(state, grid) for grid in range(len(grids))],
        [np.where(own.found[:, None], own.either_px, np.nan) for own in grids],
        [np.sqrt(2.0) * own.sigma_px for own in grids],
    )


def _light_of(state: State, grid: int) -> ArrayLight:
    array = array_of(state, grid)
    return array_light(array, [recipe(array, sign, (0,)) for sign in (1.0, -1.0)])


def map_of(state: State, sent: Array, places: Places) -> SmoothMap | FourCorners:
    """Return the map from where spots are sent to where they are seen.

    Raises
    ------
    RefusedError
        There are too few.
    """
    known = places.found
    if np.count_nonzero(known) < FEWEST:
        raise RefusedError(
            f"{np.count_nonzero(known)} spots of {len(known)} were found; the limit is {FEWEST}.",
            why="A map of the field needs more.",
            fix="See the report's picture: light, focus, and that the camera sees the field.",
            measured=int(np.count_nonzero(known)),
            limit=FEWEST,
            code="too-few-spots",
        )
    if state.parameters.mode == "corners":
        return corners_of(sent, places)
    found = fit_smooth_map(sent[known], places.ideal_px[known], sigma_px=places.sigma_px[known])
    if found.holdout_rms_px > ROUGHEST_PX:
        raise RefusedError(
            f"no smooth map explains where the spots are seen: it misses spots that it has not seen by "
            f"{found.holdout_rms_px:.2g} px (rms); the limit is {ROUGHEST_PX:g} px.",
            why="Spots were taken for others, or light that is no spot was taken for one.",
            fix="See the report's pictures: look for reflections, and align the bench roughly.",
            measured=found.holdout_rms_px,
            limit=ROUGHEST_PX,
            code="no-smooth-map",
        )
    return found


def corners_of(sent: Array, places: Places) -> FourCorners:
    """Return the thesis's map: the homography of the four spots that lie farthest out."""
    four = outermost(sent, places.found)
    return FourCorners.through(sent[four], places.ideal_px[four])


def with_map(state: State) -> State:
    """Return the state with what the map's inverse sends for the verification's spots."""
    camera = state.facts.camera
    state = with_light(state)
    sent, places = measured(state)
    found = map_of(state, sent, places)
    wanted = zone_directions(state.parameters.points - 1, camera.field_rad)
    at, sure = found.inverse(ideal_pixels(wanted, camera))
    sent_tan = ideal_tangents(at, camera)
    sure &= in_the_picture(wanted, camera, EDGE_PX)
    off = np.linalg.norm((places.ideal_px - sent)[places.found], axis=1)
    return replace(
        state,
        sent_tan=sent_tan[sure],
        wanted_tan=wanted[sure],
        rms_px=float(np.sqrt(np.mean(off**2))),
        noise_px=float(np.median(places.sigma_px[places.found])),
    )
