"""How a device is mounted: its pixels brought into the bench's frame before anything else sees them.

In the bench's frame row 0 is the largest y and column 0 the smallest x (docs/decisions/0013).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Camera, Finding, Frame, Inspectable, Shown, Slm
from holocal.records.facts import CameraFacts, SlmFacts


@dataclass(frozen=True)
class Mounting:
    """What turns a device's picture into the bench's: first a turn, counterclockwise as the picture is seen, then a
    mirroring of left and right."""

    rotate_deg: Literal[0, 90, 180, 270] = 0
    mirror: bool = False

    @property
    def swaps_sides(self) -> bool:
        """Whether width and height change places."""
        return self.rotate_deg in (90, 270)

    def to_bench(self, picture: NDArray[Any]) -> NDArray[Any]:
        """Return a device's picture (height, width) as the bench has it."""
        turned = np.rot90(picture, self.rotate_deg // 90)
        return np.ascontiguousarray(turned[:, ::-1] if self.mirror else turned)

    def to_device(self, picture: NDArray[Any]) -> NDArray[Any]:
        """Return the bench's picture (height, width) as the device has it: the inverse of `to_bench`."""
        straight = picture[:, ::-1] if self.mirror else picture
        return np.ascontiguousarray(np.rot90(straight, -(self.rotate_deg // 90)))


def _findings(device: object) -> tuple[Finding, ...]:
    return device.inspect() if isinstance(device, Inspectable) else ()


def _identity(device: object, mounting: Mounting) -> dict[str, Any]:
    """Return what a calibration hangs on: the device's own settings, and how it stands where that is not straight."""
    own: dict[str, Any] = getattr(device, "identity", dict)()
    return {**own, **({} if mounting == Mounting() else {"rotate_deg": mounting.rotate_deg, "mirror": mounting.mirror})}


@dataclass(frozen=True)
class MountedCamera:
    """A camera whose frames come in the bench's frame."""

    device: Camera
    mounting: Mounting

    def describe(self) -> CameraFacts:
        """Return the camera's facts, width and height as the bench has them."""
        facts = self.device.describe()
        if not self.mounting.swaps_sides:
            return facts
        return replace(facts, width=facts.height, height=facts.width, field_rad=facts.field_rad[::-1])

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure and return what the camera made of it, seconds."""
        return self.device.set_exposure(exposure_s)

    def grab(self) -> Frame:
        """Take one fresh frame."""
        frame = self.device.grab()
        return replace(frame, counts=self.mounting.to_bench(frame.counts))

    def inspect(self) -> tuple[Finding, ...]:
        """Return what the camera says of its set-up."""
        return _findings(self.device)

    def identity(self) -> dict[str, Any]:
        """Return what a calibration hangs on beyond the facts."""
        return _identity(self.device, self.mounting)


@dataclass(frozen=True)
class MountedSlm:
    """A panel that takes levels in the bench's frame."""

    device: Slm
    mounting: Mounting

    def describe(self) -> SlmFacts:
        """Return the panel's facts, width and height as the bench has them."""
        facts = self.device.describe()
        return replace(facts, width=facts.height, height=facts.width) if self.mounting.swaps_sides else facts

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        """Show (height, width) levels."""
        turned = self.mounting.to_device(levels)
        shown = self.device.show(turned)
        if shown.sha256 != hashlib.sha256(turned.data).hexdigest():
            return shown  # the device shows something else: its word stands
        return replace(shown, sha256=hashlib.sha256(np.ascontiguousarray(levels).data).hexdigest())

    def blank(self) -> None:
        """Show level 0 everywhere."""
        self.device.blank()

    def inspect(self) -> tuple[Finding, ...]:
        """Return what the panel says of its set-up."""
        return _findings(self.device)

    def identity(self) -> dict[str, Any]:
        """Return what a calibration hangs on beyond the facts."""
        return _identity(self.device, self.mounting)
