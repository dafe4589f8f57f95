"""The accepted response measured again: a few levels with the verification's pattern, against the accepted table."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import TYPE_CHECKING

from holocal.errors import RefusedError
from holocal.loop.devices import Frame
from holocal.loop.procedure import Remeasured, Shot, taken
from holocal.records.calibration import Accepted
from holocal.records.response import response_of
from procedures._response_frames import choose_pixels, light_of, phases_of
from procedures._response_result import error_at

if TYPE_CHECKING:
    from procedures.response import Response, State

LEVELS = 8  # an ellipse has five parameters


def remeasured(procedure: Response, state: State, accepted: Accepted) -> Generator[Shot, Frame, Remeasured]:
    """Yield a dark frame and those of the verification, with fewer levels; return how far the table is from them.

    `state` is the first state of a run; the accepted exposure is put into it.
    """
    from procedures.response import verify_levels

    chosen = state.parameters.model_copy(update={"verify_levels": LEVELS})
    state = replace(state, parameters=chosen, exposure_s=float(accepted.result["exposure_s"]), shown=(0,))
    shots = list(procedure.verification(state))
    dark = (yield replace(shots[0], label="dark", levels=None)).counts
    frames = yield from taken(shots)
    camera, shown = state.facts.camera, verify_levels(state)
    pixels = choose_pixels(frames, dark, camera)
    light = light_of(frames, dark, pixels, camera=camera, exposure_s=frames[0].exposure_s)
    fresh = phases_of(light, shown, range(len(shown)))
    table = response_of(accepted).at(chosen.wavelength_nm)
    if table is None or not fresh.valid:
        raise RefusedError(f"no fringe was found: {fresh.reason}" if table is not None else "it is of another line.")
    rising = table[-1] > table[0]
    check = error_at(fresh.levels, table, fresh.phase_rad * (1.0 if rising else -1.0), fresh.covariance)
    return Remeasured({"phase_error_rms_rad": check.rms_rad}, {"phase_error_rms_rad": check.rms_sigma_rad})
