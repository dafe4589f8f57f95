"""The accepted aberration measured again: corrected spots with and without defocus, what is left of each zone."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from holocal.errors import RefusedError
from holocal.loop.devices import Frame
from holocal.loop.procedure import Remeasured, Shot, taken
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures._aberration_light import array_of, correction_of, told
from procedures._aberration_model import ModelMode, verified
from procedures._aberration_result import estimate_of, side_of, sigmas_of

FEWEST_ZONES = 0.6  # of those that were believed

if TYPE_CHECKING:
    from procedures.aberration import Parameters


def remeasured(
    facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, reference: Reference, seed: int
) -> Generator[Shot, Frame, Remeasured]:
    """Yield the verification's frames of mode model, whichever mode was accepted; return what is left of every zone."""
    mode, accepted = ModelMode(), calibration["aberration"]
    state = mode.start(facts, calibration, parameters.model_copy(update={"mode": "model"}), seed)
    coefficients = np.asarray(accepted.result["field"]["coefficients_rad"], np.float64)
    state = replace(state, coefficients_rad=coefficients, reference=reference)
    if seen := accepted.result.get("verified_with"):
        state = replace(state, next_gain=np.asarray(seen["gains"], np.float64), exposure_s=float(seen["exposure_s"]))
    else:  # another mode was accepted: brightness is shared out anew
        state = told(state, reference)
        state = replace(state, exposure_s=state.guess_s)
    fresh = verified(state, (yield from taken(mode.verification(state))))
    array, found = array_of(state), estimate_of(fresh)
    believed, before = int(found.valid.sum()), int(accepted.result["zones_believed"])
    if believed < FEWEST_ZONES * before:
        raise RefusedError(
            f"{believed} zones can be measured of {before} when it was accepted; the limit is {FEWEST_ZONES:.0%}."
        )
    wider = float(accepted.result.get("sigma_widened_by", 1.0)) ** 2
    left, unknown = found.field.zones + correction_of(state), np.full(len(array.field_tan), np.nan)
    after = side_of(array, found, left, wider * found.field.zone_covariance, unknown, state.parameters.noll)
    numbers = {f"{which}_wavefront_rms_rad": after[which]["wavefront_rms_rad"] for which in ("median", "worst")}
    return Remeasured(numbers, sigmas_of(after))
