"""What the loop asks of devices: levels to an SLM, counts from a camera, light that can be switched.

Every rig gives a `Rig`; a lab's own rig is a package with an entry point in the group ``holocal.rigs`` that names a
function ``open_rig(config: holocal.records.rig.RigConfig) -> Rig``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from holocal.records.facts import CameraFacts, RigFacts, SlmFacts


@dataclass(frozen=True)
class Shown:
    """What an SLM says after `show`: SHA-256 of the levels, and whether a read-back agreed (None: cannot read back)."""

    sha256: str
    read_back_ok: bool | None


@dataclass(frozen=True)
class Frame:
    """One camera frame.

    `counts` is (height, width) uint16, row 0 on top; `exposure_s` is what the camera says it used, not what was
    asked; `saturated_fraction` is the share of pixels at full scale; `frame_id` rises by at least 1 per grab.
    """

    counts: NDArray[np.uint16]
    exposure_s: float
    frame_id: int
    saturated_fraction: float
    lost_packets: int = 0


@dataclass(frozen=True)
class Finding:
    """What a device says of its own set-up: `ok` None where it cannot be known (a virtual output has no gamma ramp)."""

    title: str
    measured: float | str
    limit: float | str
    unit: str
    ok: bool | None
    remedy: str


@runtime_checkable
class Inspectable(Protocol):
    """What an SLM, a camera or a light adds when it can say how it is set up; the pre-flight asks, without light."""

    def inspect(self) -> tuple[Finding, ...]:
        """Return the findings: for an output its mode, rotation, gamma ramp; for a camera automatic gain, and so on."""
        ...


@runtime_checkable
class Slm(Protocol):
    """A phase panel: takes levels, never radians."""

    def describe(self) -> SlmFacts:
        """Return the panel's facts."""
        ...

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        """Show (height, width) levels; returns when they are on the panel and settled."""
        ...

    def blank(self) -> None:
        """Show level 0 everywhere; safe to call at any time, twice too."""
        ...


@runtime_checkable
class Camera(Protocol):
    """A camera: gives counts with the exposure that was used."""

    def describe(self) -> CameraFacts:
        """Return the camera's facts."""
        ...

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure and return what the camera made of it, seconds."""
        ...

    def grab(self) -> Frame:
        """Take one fresh frame, triggered after the call."""
        ...


@runtime_checkable
class Light(Protocol):
    """The source. It is never made brighter by software: on, off and which wavelength."""

    def select(self, wavelength_m: float) -> None:
        """Choose the laser line nearest to a wavelength; raises ConfigError when there is none within 1 nm."""
        ...

    def on(self) -> None:
        """Switch the light on."""
        ...

    def off(self) -> None:
        """Switch the light off; safe to call at any time, twice too."""
        ...


@runtime_checkable
class Rig(Protocol):
    """A bench: panel, camera, light, opened and closed together."""

    # Properties here, so that a rig may have its own types of device; plain attributes do.
    @property
    def slm(self) -> Slm:
        """The panel."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera."""
        ...

    @property
    def light(self) -> Light:
        """The source."""
        ...

    def facts(self) -> RigFacts:
        """Return what the rig says of itself."""
        ...

    def truth(self) -> dict[str, Any] | None:
        """Return what a simulated rig alone can know, JSON-ready, for `result.json` only; None for a real rig."""
        ...

    def close(self) -> None:
        """Blank the panel, switch the light off, let the devices go; safe to call twice."""
        ...


@runtime_checkable
class Repeatable(Protocol):
    """What a simulated rig adds to `Rig`: noise from (seed, step), so a resumed run equals an unbroken one."""

    def begin_step(self, seed: int, step: int) -> None:
        """Start the noise of a step; the runner calls it before the first shot of the pre-flight (step -1) and of every
        step (0, 1, ...; the verification is the step after the last)."""
        ...
