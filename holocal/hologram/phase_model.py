"""The phase that the engine wants at the panel: exact path lengths, with the wavefront correction in force."""

from __future__ import annotations

import numpy as np

from holocal.errors import InputError
from holocal.hologram.settings import HologramSettings
from holocal.optics.bench import Array
from holocal.optics.phase_function import ExactPhase, VirtualPoints, exact_phase

_LOST_M = 1e-8  # a landing so far off costs 4e-3 rad


def wanted_phase(settings: HologramSettings, points: VirtualPoints, slm_m: Array, *, steps: int = 6) -> ExactPhase:
    """Return phi of points (...) at panel points (..., 2), broadcast together, and where their rays cross the pupil."""
    found = exact_phase(
        settings.bench,
        points,
        slm_m,
        wavelength_m=settings.wavelength_m,
        gaze_rad=settings.gaze_rad,
        steps=steps,
    )
    inside = np.linalg.norm(found.pupil_m, axis=-1) <= settings.bench.pupil_diameter_m / 2
    lost = inside & ~(found.error_m <= _LOST_M)
    if np.any(lost):
        raise InputError(
            f"{int(lost.sum())} of {int(inside.sum())} rays through the pupil were not found: they land "
            f"{float(found.error_m[lost].min()):.3g} m off the panel's points.",
            fix="Check the bench's misalignment and the gaze; use a smaller field or points farther away.",
            measured=float(found.error_m[lost].min()),
            limit=_LOST_M,
        )
    if settings.wavefront is None or settings.wavefront.is_identity():
        return found
    added = settings.wavefront.phase(
        points.field_tan,
        found.pupil_m,
        pupil_diameter_m=settings.bench.pupil_diameter_m,
        wavelength_m=settings.wavelength_m,
    )
    return ExactPhase(found.phase_rad + added, found.pupil_m, found.error_m)
