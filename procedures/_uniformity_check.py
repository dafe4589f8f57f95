"""The accepted uniformity measured again: the corrected field, fresh phases, over the field that was correctable."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from holocal.estimate.uniformity import measure_uniformity
from holocal.loop.devices import Frame
from holocal.loop.procedure import Remeasured, Shot, taken
from holocal.records.calibration import Accepted
from holocal.records.field_map import field_map

if TYPE_CHECKING:
    from procedures.uniformity import State, Uniformity

WEIGHT = "correction.intensity_weight"


def remeasured(procedure: Uniformity, state: State, accepted: Accepted) -> Generator[Shot, Frame, Remeasured]:
    """Yield a dark frame and those of the verification; return how uneven they are.

    `state` is the first state of a run; the accepted weights and exposure are put into it.
    """
    from procedures.uniformity import brightness_of

    weights = field_map(accepted, WEIGHT).values.astype(np.float32)
    valid = field_map(accepted, "valid").values > 0.5
    state = replace(state, weights=weights[None], exposure_s=float(accepted.result["exposure_s"]))
    dark = (yield replace(next(procedure.verification(state)), label="dark", levels=None)).counts.astype(np.float32)
    frames = yield from taken(procedure.verification(state))
    pictures = [brightness_of(frame, dark) for frame in frames]
    found = measure_uniformity(np.stack(pictures).astype(np.float64), valid, block_px=state.parameters.block_px)
    return Remeasured(
        {"nonuniformity_rms": found.rms, "nonuniformity_9pt": found.nine_point},
        {"nonuniformity_rms": found.rms_sigma, "nonuniformity_9pt": found.nine_point_sigma},
    )
