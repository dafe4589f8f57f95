"""What a rig says of itself, as frozen data: all that the loop, the engine and a procedure may know of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class SlmFacts:
    """A phase-only panel: pixels, pitch in metres, 2**bits levels; level L is nominally the phase 2 pi L / 2**bits."""

    width: int
    height: int
    pitch_m: float
    bits: int = 8
    vendor: str = ""
    model: str = ""
    serial: str = ""


@dataclass(frozen=True)
class CameraFacts:
    """A camera where the eye would be.

    `field_rad` is its full nominal field (width, height). The picture is rectilinear: pixel j of n of the width looks
    along x/z = tan(field_rad / 2) * (2 j + 1 - n) / n; row 0 is the top (largest y). That is before the camera's own
    geometry, as its calibration says it: turned by `rotation_rad` (positive from +x towards +y), what lies at the
    tangent r is seen at r (1 + k1 r^2 + k2 r^4).
    """

    width: int
    height: int
    field_rad: tuple[float, float]
    full_scale: int
    exposure_min_s: float
    exposure_max_s: float
    bits: int = 12
    vendor: str = ""
    model: str = ""
    serial: str = ""
    rotation_rad: float = 0.0
    k1: float = 0.0
    k2: float = 0.0


@dataclass(frozen=True)
class RigFacts:
    """All that is known of a rig before anything is measured. `fingerprint` is flat and JSON-ready."""

    name: str
    slm: SlmFacts
    camera: CameraFacts
    wavelengths_m: tuple[float, ...]
    pupil_diameter_m: float
    eye_relief_m: float
    simulated: bool
    fingerprint: dict[str, Any] = field(default_factory=dict)
