"""A lab's own drivers, each a plug-in by itself; HISTORY is what was called, in order."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from holocal.errors import DeviceError
from holocal.loop.devices import Finding, Frame, Shown
from holocal.records.facts import CameraFacts, SlmFacts
from rigs.context import DriverContext

HISTORY: list[str] = []
CONTEXTS: list[DriverContext] = []


@dataclass
class Part:
    """What every part has: its table; a fault of it is a call that fails."""

    kind: str
    table: Mapping[str, Any]

    def said(self, what: str) -> None:
        HISTORY.append(f"{self.kind}.{what}")
        if self.table.get("fails") == what:
            raise DeviceError(f"the {self.kind} failed at {what}")

    def close(self) -> None:
        self.said("close")


@dataclass
class LabSlm(Part):
    facts: SlmFacts = field(default_factory=lambda: SlmFacts(16, 9, 8e-6, serial="P-1"))

    def describe(self) -> SlmFacts:
        return self.facts

    def show(self, levels: np.ndarray) -> Shown:
        self.said("show")
        return Shown(hashlib.sha256(levels.tobytes()).hexdigest(), None)

    def blank(self) -> None:
        self.said("blank")


@dataclass
class LabCamera(Part):
    exposure_s: float = 0.01
    rounds_up: float = 1.0

    def describe(self) -> CameraFacts:
        return CameraFacts(20, 10, (0.4, 0.2), 4095, 1e-5, 2.0, serial="C-1")

    def set_exposure(self, exposure_s: float) -> float:
        self.exposure_s = exposure_s * float(self.table.get("rounds_up", 1.0))
        return self.exposure_s

    def grab(self) -> Frame:
        return Frame(np.zeros((10, 20), np.uint16), self.exposure_s, 1, 0.0)

    def inspect(self) -> tuple[Finding, ...]:
        return (Finding("gamma", "off", "off", "", True, ""),)

    def identity(self) -> Mapping[str, Any]:
        return {"gain": 3}


@dataclass
class LabLight(Part):
    def select(self, wavelength_m: float) -> None:
        self.said("select")

    def on(self) -> None:
        self.said("on")

    def off(self) -> None:
        self.said("off")


def _open(made: Part, context: DriverContext) -> Any:
    made.said("open")
    CONTEXTS.append(context)
    return made


def open_slm(table: Mapping[str, Any], context: DriverContext) -> LabSlm:
    return _open(LabSlm("slm", table), context)


def open_camera(table: Mapping[str, Any], context: DriverContext) -> LabCamera:
    return _open(LabCamera("camera", table), context)


def open_light(table: Mapping[str, Any], context: DriverContext) -> LabLight:
    return _open(LabLight("light", table), context)
