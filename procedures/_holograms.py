"""A rig's holograms: the engine with the rig's facts and the response in force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from holocal.records.facts import RigFacts
from holocal.records.response import RESPONSE, response_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Engine:
    """How the frames of a procedure are computed; `zones` None: warped patches, else the thesis's zones."""

    wavelength_nm: float
    zones: int | None = None
    iterations: int = 10
    device: str = "cpu"


def nominal_response(facts: RigFacts) -> Array:
    """Return 2 pi L / 2**bits, what level L stands for on a panel that is not measured."""
    count = 2**facts.slm.bits
    return np.asarray(np.arange(count) * (2 * np.pi / count))


def response_in_force(calibration: Mapping[str, Any], facts: RigFacts, wavelength_nm: float) -> Array:
    """Return the phase of each level: the accepted response where there is one for this line, else the nominal one."""
    accepted = calibration.get(RESPONSE)
    measured = response_of(accepted).at(wavelength_nm) if accepted is not None else None
    return nominal_response(facts) if measured is None else measured


def image_levels(
    image: NDArray[np.floating[Any]], facts: RigFacts, engine: Engine, *, seed: int, response_rad: ArrayLike
) -> NDArray[np.uint8]:
    """Return the levels that show an image of these intensities over the camera's field."""
    from holocal.hologram.pipeline import HologramSettings, render_image
    from holocal.hologram.settings import Warped, Zones
    from holocal.optics.bench import Bench, Panel

    settings = HologramSettings(
        panel=Panel(facts.slm.width, facts.slm.height, facts.slm.pitch_m),
        bench=Bench.nominal(pupil_diameter_m=facts.pupil_diameter_m, eye_relief_m=facts.eye_relief_m),
        wavelength_m=engine.wavelength_nm * 1e-9,
        fov_rad=facts.camera.field_rad,
        method=Warped() if engine.zones is None else Zones(engine.zones),
        iterations=engine.iterations,
        device=engine.device,
    )
    # A table that says 2 pi L / 256 is the engine's own: without it the same bytes as ever.
    nominal = facts.slm.bits == 8 and np.array_equal(response_rad, nominal_response(facts))
    return render_image(image, settings, seed=seed, response_rad=None if nominal else response_rad).levels
