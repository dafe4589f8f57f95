"""A small bench made of arrays: the picture follows the levels, a fault can be switched on, and a diary is kept."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame, Shown
from holocal.records.facts import CameraFacts, RigFacts, SlmFacts
from holocal.records.rig import RigConfig

FULL_SCALE = 4095
COUNTS_PER_SECOND = 1.0e5  # of a lit pixel: half of full scale at 20 ms


class Diary:
    """What was done to the bench, a word per line in a file that outlives the process; nothing without a file."""

    def __init__(self, path: str) -> None:
        self.path = Path(path) if path else None

    def note(self, word: str) -> None:
        if self.path is not None:
            with self.path.open("a") as file:
                file.write(f"{word}\n")


class Panel:
    """An SLM that shows what it is told, unless it is frozen."""

    def __init__(self, facts: SlmFacts, fault: str, diary: Diary) -> None:
        self.facts, self.fault, self.diary = facts, fault, diary
        self.levels: NDArray[np.uint8] = np.zeros((facts.height, facts.width), np.uint8)
        self.blanked = 0

    def describe(self) -> SlmFacts:
        return self.facts

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        self.diary.note("show")
        if self.fault != "frozen-panel":
            self.levels = levels.copy()
        read_back = None if self.fault != "read-back" else False
        return Shown(hashlib.sha256(levels.tobytes()).hexdigest(), read_back)

    def blank(self) -> None:
        self.diary.note("blank")
        self.levels = np.zeros_like(self.levels)
        self.blanked += 1


class Lamp:
    """A light with one line."""

    def __init__(self, diary: Diary) -> None:
        self.lit = False
        self.history: list[bool] = []
        self.diary = diary

    def select(self, wavelength_m: float) -> None:
        pass

    def on(self) -> None:
        self.diary.note("on")
        self.lit = True
        self.history.append(True)

    def off(self) -> None:
        self.diary.note("off")
        self.lit = False
        self.history.append(False)


class Eye:
    """A camera with noise from (seed, step, grab), and the fault of the bench."""

    def __init__(self, facts: CameraFacts, panel: Panel, lamp: Lamp, faults: dict[str, Any]) -> None:
        self.facts, self.panel, self.lamp, self.faults = facts, panel, lamp, faults
        self.exposure_s = 0.02
        self.grabs = 0
        self.noise = np.random.default_rng(0)
        self.last: NDArray[np.uint16] | None = None

    def describe(self) -> CameraFacts:
        return self.facts

    def set_exposure(self, exposure_s: float) -> float:
        self.exposure_s = exposure_s
        return exposure_s

    def grab(self) -> Frame:
        self.grabs += 1
        self.lamp.diary.note("grab")
        time.sleep(self.faults["slow_s"])
        kind = self.faults["kind"] if self.grabs >= self.faults["at"] else "none"
        if kind == "unplugged":
            raise TimeoutError("no frame within 2 s")
        counts = self._picture(1000.0 if self.faults["kind"] == "too-bright" else 1.0)
        if self.faults["kind"] == "left-justified":
            counts = (counts << 4).clip(0, 65535).astype(np.uint16)
        once = self.grabs == self.faults["at"]
        if (kind == "frozen" or (kind == "frozen-once" and once)) and self.last is not None:
            counts = self.last
        if kind == "not-a-number":
            counts = np.full(counts.shape, np.nan)  # type: ignore[assignment]
        self.last = counts
        lost = 3 if kind == "lost" or (kind == "lost-once" and once) else 0
        number = 1 if kind == "stale" else self.grabs
        saturated = float(np.mean(counts >= self.facts.full_scale))
        return Frame(counts, self.exposure_s, number, saturated, lost)

    def _picture(self, brightness: float) -> NDArray[np.uint16]:
        shape = (self.facts.height, self.facts.width)
        light = 0.02 * np.ones(shape)
        if self.panel.levels.any():
            seed = int.from_bytes(hashlib.sha256(self.panel.levels.tobytes()).digest()[:8], "big")
            light = np.random.default_rng(seed).uniform(0.3, 1.0, shape) * self.panel.levels.mean() / 255.0 * 2.0
        signal = brightness * COUNTS_PER_SECOND * self.exposure_s * light * self.lamp.lit
        noisy = signal + 100.0 + self.noise.normal(0.0, 4.0, shape)
        return noisy.round().clip(0, FULL_SCALE).astype(np.uint16)


class LabRig:
    """The bench: panel, camera, lamp; repeatable, so a resumed run can be compared with an unbroken one."""

    def __init__(self, config: RigConfig) -> None:
        slm, camera, faults = (dict(config.tables[key]) for key in ("slm", "camera", "faults"))
        self._facts = RigFacts(
            name=config.name,
            slm=SlmFacts(slm["width"], slm["height"], 8e-6, serial="SLM-1"),
            camera=CameraFacts(
                camera["width"],
                camera["height"],
                (0.4, 0.3),
                FULL_SCALE if faults["kind"] != "left-justified" else 65535,
                1e-4,
                0.1,
                serial=camera["serial"],
            ),
            wavelengths_m=(515e-9,),
            pupil_diameter_m=3e-3,
            eye_relief_m=12e-3,
            simulated=faults["simulated"],
        )
        diary = Diary(faults["diary"])
        self.slm = Panel(self._facts.slm, faults["kind"], diary)
        self.light = Lamp(diary)
        self.camera = Eye(self._facts.camera, self.slm, self.light, faults)
        self.closed = False
        if faults["lit_when_opened"]:
            self.light.on()
        diary.note("open")
        time.sleep(faults["slow_open_s"])

    def facts(self) -> RigFacts:
        return self._facts

    def truth(self) -> dict[str, Any] | None:
        return {"gain": 1.0} if self._facts.simulated else None

    def begin_step(self, seed: int, step: int) -> None:
        self.camera.noise = np.random.default_rng([seed, step + 10])

    def close(self) -> None:
        self.slm.blank()
        self.light.off()
        self.closed = True


def open_rig(config: RigConfig) -> LabRig:
    return LabRig(config)


@dataclass(frozen=True)
class Seen:
    """A device that answered; its handle is nothing to print."""

    model: str
    serial: str
    handle: object = field(repr=False, default=None)


def discover() -> list[Seen | dict[str, Any]]:
    """Devices as dataclasses or as mappings: either will do."""
    return [Seen("eye", "CAM-1", object()), {"model": "panel", "output": "HDMI-2", "width": 1920}]


def discover_without_card() -> list[Seen]:
    raise OSError("no network card")
