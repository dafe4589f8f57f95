"""The search for an exposure: darker by ten while the light clips, brighter while it is faint."""

from __future__ import annotations

import numpy as np

from holocal.errors import SafetyStop
from holocal.loop.devices import Frame
from holocal.records.facts import CameraFacts

CLIPPED = 1e-3  # share of the pixels; a few are hot
FAINT, WANTED = 0.01, 0.1  # of full scale: below the first the exposure is raised towards the second
BRIGHTER = 30.0  # at most, from one frame to the next


def next_guess(frame: Frame, camera: CameraFacts, *, brightest: float, last: bool) -> float | None:
    """Return the exposure to try next, None when this frame is good enough to compute the final one from.

    Parameters
    ----------
    brightest
        The counts above the dark level of what shall not clip.
    last
        No further frame may be spent.

    Raises
    ------
    SafetyStop
        The light clips at the camera's shortest exposure.
    """
    clipped, faint = frame.saturated_fraction > CLIPPED, brightest < FAINT * camera.full_scale
    if last or not (clipped or faint):
        return None
    factor = 0.1 if clipped else min(BRIGHTER, WANTED * camera.full_scale / max(brightest, 1.0))
    guess = float(np.clip(frame.exposure_s * factor, camera.exposure_min_s, camera.exposure_max_s))
    if guess != frame.exposure_s:
        return guess
    if clipped:
        raise SafetyStop(
            f"{frame.saturated_fraction:.2%} of the pixels clip at the camera's shortest exposure, "
            f"{1e3 * camera.exposure_min_s:g} ms.",
            why="Clipped light is not measured, and may harm the sensor.",
            fix="Put a neutral density filter in the beam or lower the laser's power by hand.",
            measured=frame.saturated_fraction,
            limit=CLIPPED,
            code="too-bright",
        )
    return None
