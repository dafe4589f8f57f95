"""The accepted distortion measured again: spots sent through the accepted map, where they are seen."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from holocal.errors import RefusedError
from holocal.estimate.camera_lens import ideal_pixels
from holocal.loop.devices import Frame
from holocal.loop.procedure import Remeasured, Shot, taken
from holocal.records.calibration import Accepted
from holocal.records.field_map import field_map
from procedures._aberration_spots import zone_directions
from procedures._bench_light import PARAMETERS
from procedures._distortion_map import EDGE_PX, array_of, moved
from procedures._distortion_points import in_the_picture, places_of_pair
from procedures._distortion_result import FEWEST_SEEN, side_of, sigma_of

if TYPE_CHECKING:
    from procedures.distortion import Distortion, State

SHIFTS = ("correction.shift_tan_x", "correction.shift_tan_y")


def remeasured(procedure: Distortion, state: State, accepted: Accepted) -> Generator[Shot, Frame, Remeasured]:
    """Yield the verification's frames; return how far the spots are from where they should be.

    `state` is the first state of a run; what the accepted map sends, and its exposure, are put into it.
    """
    camera = state.facts.camera
    wanted = zone_directions(state.parameters.points - 1, camera.field_rad)
    sure = (field_map(accepted, "valid").at(wanted) > 0.5) & in_the_picture(wanted, camera, EDGE_PX)
    wanted = wanted[sure]
    shift = np.stack([field_map(accepted, name).at(wanted) for name in SHIFTS], axis=-1)
    exposure_s = float(accepted.result["exposures_s"][-1])
    light = np.array([accepted.result.get("light_model", {}).get(name, np.nan) for name in PARAMETERS])
    light = light if np.isfinite(light).all() else np.zeros(0)  # runs of before there was one
    state = replace(state, sent_tan=wanted + shift, wanted_tan=wanted, exposure_s=exposure_s, light_values=light)
    frames = yield from taken(procedure.verification(state))
    array = array_of(state, 2)
    pictures, exposures_s = [frame.counts for frame in frames], [frame.exposure_s for frame in frames]
    places = places_of_pair(array, pictures, exposures_s, state.reference, wanted_tan=wanted)
    places = moved(state, 2, places)
    off = places.ideal_px - ideal_pixels(wanted, camera)
    after = side_of(off, places.found, int(array.on.sum()))
    if after["points_found"] < FEWEST_SEEN * after["points_expected"]:
        raise RefusedError(
            f"{after['points_found']} of {after['points_expected']} spots are seen near where they should be; "
            f"the limit is {FEWEST_SEEN:.0%}."
        )
    return Remeasured({name: after[name] for name in ("rms_px", "max_px")}, sigma_of(off, places))
