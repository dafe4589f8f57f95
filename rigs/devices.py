"""A bench put together from drivers: one SLM, one camera, one light, each named in its own table of the rig's file.

A driver is an entry point of ``holocal.slms``, ``holocal.cameras`` or ``holocal.lights``: a function
``open_slm(table, context) -> Slm`` (likewise a camera, a light). It is given its table as the file has it, checks it,
and returns a device that is open: the SLM blank, the light off. A lab's package may bring one of the three alone.

A device may have more than its protocol asks for: ``inspect()`` (`holocal.loop.devices.Inspectable`), ``close()``, and
``identity()``, what of its settings a calibration hangs on beyond its facts (`Identifiable`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict, Field

from holocal.errors import HolocalError, RefusedError, SafetyStop
from holocal.loop.devices import Camera, Finding, Frame, Inspectable, Light, Slm
from holocal.records import plugins
from holocal.records.facts import CameraFacts, RigFacts
from holocal.records.rig import RigConfig
from holocal.records.rig_model import Table, WavelengthNm
from holocal.records.safety import SafetyTable
from holocal.records.validate import validated
from rigs.context import DriverContext
from rigs.mounting import MountedCamera, MountedSlm, Mounting

LOGGER = logging.getLogger("holocal.rigs")
MM, NM = 1e-3, 1e-9
LONGEST_S = 1.0  # of any exposure, where the file's [safety] names no other
EXPOSURE_EXCESS = 1.01  # a camera rounds an exposure up to its own step, a line's time: 0.1 % of a millisecond or so


class DriverTable(BaseModel):
    """``[slm]``, ``[camera]`` or ``[light]``: which driver opens it; the other keys are the driver's own."""

    model_config = ConfigDict(strict=True, extra="allow", frozen=True)

    driver: str = Field(min_length=1)


class PixelsTable(DriverTable):
    """A table of a device with pixels: how they are turned, then mirrored, into the bench's frame (`Mounting`)."""

    rotate_deg: Literal[0, 90, 180, 270] = 0
    mirror: bool = False

    @property
    def mounting(self) -> Mounting:
        """How the device stands."""
        return Mounting(self.rotate_deg, self.mirror)


class BenchOptics(Table):
    """``[optics]``: the laser lines and the eye's pupil."""

    wavelengths_nm: tuple[WavelengthNm, ...] = Field(min_length=1, max_length=16)
    pupil_mm: float = Field(default=3.0, gt=0.0, le=20.0)
    eye_relief_mm: float = Field(default=12.0, gt=0.0, le=100.0)


class DevicesFile(Table):
    """The file of a rig of kind "devices".

    `simulated` says that what the devices look at is no real bench: its results are never accepted for one.
    """

    kind: Literal["devices"]
    simulated: bool = False
    slm: PixelsTable
    camera: PixelsTable
    light: DriverTable
    optics: BenchOptics
    safety: SafetyTable = SafetyTable()


@runtime_checkable
class Identifiable(Protocol):
    """What a device adds when a calibration hangs on more of its settings than its facts say."""

    def identity(self) -> Mapping[str, Any]:
        """Return setting -> value, JSON-ready."""
        ...


@dataclass
class LimitedCamera:
    """A camera that is never asked for more light than the rig allows, whatever its driver allows."""

    camera: Camera
    longest_s: float

    def describe(self) -> CameraFacts:
        """Return the camera's facts, its longest exposure the rig's."""
        facts = self.camera.describe()
        return replace(facts, exposure_max_s=min(facts.exposure_max_s, self.longest_s))

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure, at most the rig's longest."""
        if not math.isfinite(exposure_s) or exposure_s > self.longest_s * EXPOSURE_EXCESS:
            raise self._too_long("was asked for", exposure_s)
        used_s = self.camera.set_exposure(min(exposure_s, self.longest_s))
        if used_s > self.longest_s * EXPOSURE_EXCESS:
            raise self._too_long("is what the camera made of it", used_s)
        return used_s

    def grab(self) -> Frame:
        """Take one fresh frame."""
        return self.camera.grab()

    def inspect(self) -> tuple[Finding, ...]:
        """Return the camera's findings, none where it has none."""
        return self.camera.inspect() if isinstance(self.camera, Inspectable) else ()

    def _too_long(self, how: str, exposure_s: float) -> SafetyStop:
        return SafetyStop(
            f"an exposure of {exposure_s:.6g} s {how}; safety.max_exposure_s allows {self.longest_s:g} s.",
            fix="Ask for less, or raise safety.max_exposure_s in the rig's file.",
            measured=exposure_s,
            limit=self.longest_s,
            code="exposure-ceiling",
        )


@dataclass
class DevicesRig:
    """A bench of drivers: `slm`, `camera`, `light`, opened and closed together."""

    slm: Slm
    camera: Camera
    light: Light
    _facts: RigFacts
    _stack: ExitStack = field(default_factory=ExitStack, repr=False)

    def facts(self) -> RigFacts:
        """Return what the devices say of themselves, and what the file says of the optics."""
        return self._facts

    def truth(self) -> None:
        """Return None: nobody knows what is wrong with a real bench."""
        return

    def close(self) -> None:
        """Switch the light off, blank the panel, let the devices go; safe to call twice."""
        self._stack.close()


def open_rig(config: RigConfig) -> DevicesRig:
    """Return the bench of a rig's file, open, with the light off and the panel blank.

    Raises
    ------
    ConfigError
        A key is wrong, a driver is not known, or the extra that it needs is not installed.
    RefusedError
        Another device answers than the one that the file names.
    DeviceError, BusyError
        A device does not answer, or another program has it. What was opened before it is closed again.
    """
    said = {key: f"--set {key}" for key, origin in config.origins.items() if origin == "--set"}
    file = validated(DevicesFile, config.tables, source=config.source, origins=said)
    context = DriverContext(config.name, config.source, tuple(line * NM for line in file.optics.wavelengths_nm))
    with ExitStack() as stack:
        light: Light = _opened(plugins.LIGHTS, file.light, context, stack)
        stack.callback(light.off)
        light.off()
        slm: Slm = MountedSlm(_opened(plugins.SLMS, file.slm, context, stack), file.slm.mounting)
        stack.callback(slm.blank)
        slm.blank()
        camera: Camera = MountedCamera(_opened(plugins.CAMERAS, file.camera, context, stack), file.camera.mounting)
        _require_serial("slm", file.slm, slm.describe().serial, config.source)
        _require_serial("camera", file.camera, camera.describe().serial, config.source)
        facts = _facts(config, file, slm, light, camera)
        stack.callback(light.off)  # called first on closing
        return DevicesRig(slm, LimitedCamera(camera, facts.camera.exposure_max_s), light, facts, stack.pop_all())
    raise AssertionError  # the stack swallows nothing


def _opened(group: str, table: DriverTable, context: DriverContext, stack: ExitStack) -> Any:
    """Return the device of a table; it is closed, if it can be, when `stack` is."""
    device = plugins.load(group, table.driver)(
        table.model_dump(exclude=set(PixelsTable.model_fields) - {"driver"}), context
    )
    close = getattr(device, "close", None)
    if close is not None:
        stack.callback(_closed, close)
    return device


def _closed(close: Any) -> None:
    """Close a device; a failure is written down, since the devices after it must be closed too."""
    try:
        close()
    except (HolocalError, OSError) as error:
        LOGGER.warning("a device could not be closed: %s", error)


def _require_serial(name: str, table: DriverTable, found: str, source: str) -> None:
    wanted = (table.model_extra or {}).get("serial")
    if wanted in (None, "") or wanted == found:
        return
    raise RefusedError(
        f"{source}: {name}.serial = {wanted!r}, and the device that answers has {found or 'none'!r}.",
        why="A calibration belongs to one device.",
        fix=f"Connect {wanted}, or name {found!r} in the file of another rig." if found else f"Take {name}.serial out.",
        measured=found,
        limit=wanted,
        code="other-device",
    )


def _facts(config: RigConfig, file: DevicesFile, slm: Slm, light: Light, camera: Camera) -> RigFacts:
    drivers = {"slm": file.slm.driver, "camera": file.camera.driver, "light": file.light.driver}
    flat: dict[str, Any] = {"kind": config.kind} | {f"{name}.driver": driver for name, driver in drivers.items()}
    for name, device in (("slm", slm), ("camera", camera), ("light", light)):
        if isinstance(device, Identifiable):
            flat |= {f"{name}.{key}": value for key, value in device.identity().items()}
    return RigFacts(
        name=config.name,
        slm=slm.describe(),
        camera=LimitedCamera(camera, file.safety.max_exposure_s or LONGEST_S).describe(),
        wavelengths_m=tuple(line * NM for line in file.optics.wavelengths_nm),
        pupil_diameter_m=file.optics.pupil_mm * MM,
        eye_relief_m=file.optics.eye_relief_mm * MM,
        simulated=file.simulated,
        fingerprint=flat,
    )
