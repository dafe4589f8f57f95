"""From the spots to the bench: the fit, what it predicts, and the spots that verify it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from holocal.errors import RefusedError
from holocal.estimate.bench_pose import bench_at
from holocal.estimate.camera_lens import ideal_pixels
from holocal.estimate.ray_wavefront import RayWavefronts, wavefronts
from holocal.loop.devices import Frame
from holocal.optics.bench import Bench
from holocal.optics.panel_rays import landed, middles
from procedures._aberration_spots import SpotArray, nominal_bench, recipe_levels, spots_at, zone_directions
from procedures._bench_light import (
    BEAM_PRIOR,
    CAMERA,
    CAMERA_PX,
    NUISANCE,
    ArrayLight,
    array_light,
    beam_light,
    fit_light,
    moved_px,
    pupil_light,
)
from procedures._distortion_map import EDGE_PX, array_of, spots_seen
from procedures._distortion_points import Places, evenly_bright, in_the_picture, peaks_foreseen, places_of_pair, recipe

if TYPE_CHECKING:
    from procedures.alignment import State

Array = NDArray[np.float64]
Levels = NDArray[np.uint8]

ZONES = 7  # each way, of what is predicted
WORST_SCALE = 8.0  # of the residuals, in standard errors: beyond, no pose of a mirror and a panel explains them
CAMERA_UNKNOWN_PX = 2.0  # how well a real camera's pointing, roll and scale are taken to be known
_MADE: OrderedDict[str, SpotArray] = OrderedDict()
_KEPT = 3


def with_fit(state: State) -> State:
    """Return the state with the beam and the bench that explain the spots.

    Raises
    ------
    RefusedError
        No displacement of mirror and panel explains them.
    """
    fit = fit_light(spots_seen(state.spots), prior_of(state))
    if fit.scale > WORST_SCALE:
        raise RefusedError(
            f"no displacement of mirror and panel explains the spots: they are off by {fit.scale:.1f} times their "
            f"errors; the limit is {WORST_SCALE:g}.",
            why="The bench is not the one that the rig's file draws, or the mirror has another form.",
            fix="Check [slm] pitch and size, [optics] and the camera's field, rotation and lens in the rig's file.",
            measured=fit.scale,
            limit=WORST_SCALE,
            code="not-this-bench",
        )
    return replace(
        state, values=fit.values, covariance=fit.covariance, information=fit.information, residual=fit.residual
    )


def prior_of(state: State) -> Array:
    """Return what is known before: standard deviations of `procedures._bench_light.PARAMETERS`, (p,)."""
    turn, shift = [state.parameters.prior_deg] * 3, [state.parameters.prior_mm] * 3
    camera_px = state.parameters.camera_px or (CAMERA_PX if state.facts.simulated else CAMERA_UNKNOWN_PX)
    return np.concatenate([BEAM_PRIOR, [camera_px] * len(CAMERA), turn, shift, turn, shift])


def bench_of(state: State) -> Bench:
    """Return the bench that was found."""
    return bench_at(nominal_bench(state.facts), state.values[len(NUISANCE) :])


def spots_for(state: State, wavelength_nm: float, field_tan: Array, bench: Bench | None = None) -> SpotArray:
    """Return spots made for a bench, the nominal one if none is given; the last three arrays are kept."""
    key = repr((state.facts, wavelength_nm, field_tan.tobytes(), bench))
    if key not in _MADE:
        _MADE[key] = evenly_bright(spots_at(state.facts, wavelength_nm * 1e-9, field_tan, bench))
        while len(_MADE) > _KEPT:
            _MADE.popitem(last=False)
    return _MADE[key]


@dataclass(frozen=True)
class Seen:
    """What a bench makes of points sent by the nominal bench's holograms to the zones' directions.

    `off_px` (n, 2) how far right and down they are seen of where they are sent; their `wavefront`. NaN for a zone that
    is dark.
    """

    off_px: Array
    wavefront: RayWavefronts


def zone_light(state: State) -> ArrayLight:
    """Return the zones' points, as a picture has them, made for the nominal bench."""
    chosen, camera = state.parameters, state.facts.camera
    return array_light(spots_for(state, chosen.wavelength_nm, zone_directions(ZONES, camera.field_rad)), [])


def seen_by(light: ArrayLight, bench: Bench, beam: Array) -> Seen:
    """Return what a bench makes of points."""
    array, rays = light.array, light.alone
    at = landed(bench, rays)
    lit = rays.light * pupil_light(array, at) * beam_light(array, beam, rays.slm_m)
    camera = array.facts.camera
    dark = ~array.on[:, None]
    off = np.where(
        dark, np.nan, ideal_pixels(middles(at, lit, rays.first), camera) - ideal_pixels(array.field_tan, camera)
    )
    found = wavefronts(at, lit, rays.first, radius_m=array.facts.pupil_diameter_m / 2, wavelength_m=array.wavelength_m)
    return Seen(off, found)


def verification_array(state: State) -> SpotArray:
    """Return the verification's spots, made for the bench that was found, in its own colour."""
    camera = state.facts.camera
    wanted = zone_directions(state.parameters.points - 1, camera.field_rad)
    wanted = wanted[in_the_picture(wanted, camera, EDGE_PX)]
    return spots_for(state, state.verify_nm, wanted, bench_of(state))


def verification_levels(state: State, sign: float, seeds: Sequence[int]) -> Levels:
    """Return the levels that show the verification's spots with a defocus of this sign."""
    array = verification_array(state)
    return recipe_levels(array, recipe(array, sign, seeds), state.verify_rad, state.parameters.device, only_pupil=True)


def verification_exposure_s(state: State) -> float:
    """Return the exposure of the verification: as bright as the spots before, if both lasers are."""
    camera = state.facts.camera
    peaks = [
        float(np.median(peaks_foreseen(array, 1.0)[array.on])) if array.on.any() else 1.0
        for array in (array_of(state.spots, 0), verification_array(state))
    ]
    wanted = 0.5 * state.spots.exposure_s * peaks[0] / max(peaks[1], 1e-30)
    return float(np.clip(wanted, camera.exposure_min_s, camera.exposure_max_s))


def verified(state: State, frames: Sequence[Frame]) -> tuple[SpotArray, Places]:
    """Return the verification's spots and where a picture's points would be seen."""
    array = verification_array(state)
    places = places_of_pair(
        array, [frame.counts for frame in frames], [frame.exposure_s for frame in frames], state.spots.reference
    )
    light = array_light(array, [recipe(array, sign, (0,)) for sign in (1.0, -1.0)])
    return array, replace(places, ideal_px=places.ideal_px + moved_px(light, state.values))
