"""The phase that the engine wants at the panel: exact path lengths, with the wavefront correction in force."""

from __future__ import annotations

from holocal.hologram.settings import HologramSettings
from holocal.optics.bench import Array
from holocal.optics.phase_function import ExactPhase, VirtualPoints, exact_phase


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
    if settings.wavefront is None or settings.wavefront.is_identity():
        return found
    added = settings.wavefront.phase(
        points.field_tan,
        found.pupil_m,
        pupil_diameter_m=settings.bench.pupil_diameter_m,
        wavelength_m=settings.wavelength_m,
    )
    return ExactPhase(found.phase_rad + added, found.pupil_m, found.error_m)
