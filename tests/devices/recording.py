"""A rig that writes down every frame that its camera gives, as `rigs.recorded` reads it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from lab_bench.rig import LabRig
from numpy.typing import NDArray

from holocal.loop.devices import Frame, Shown
from holocal.loop.record import RunRecord
from rigs.recorded import PREFLIGHT_STEP


class RecordingRig:
    """The lab's bench, its camera's every frame kept in a run's directory."""

    def __init__(self, rig: LabRig, record: RunRecord) -> None:
        self.rig, self.record = rig, record
        self.slm = self.camera = self.light = self
        self.step, self.lit, self.sha256, self.asked_s = -1, False, None, 0.0
        self.taken: list[Frame] = []

    def facts(self) -> Any:
        return self.rig.facts()

    def truth(self) -> Any:
        return self.rig.truth()

    def begin_step(self, seed: int, step: int) -> None:
        self.step = step
        if step == PREFLIGHT_STEP:  # a sitting begins; the runner has cut the journal back by now
            self.record.journal("camera", **asdict(self.rig.camera.facts))
        self.rig.begin_step(seed, step)

    def describe(self) -> Any:
        return self.rig.facts().camera

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        shown = self.rig.slm.show(levels)
        self.sha256 = shown.sha256
        return shown

    def blank(self) -> None:
        self.rig.slm.blank()

    def select(self, wavelength_m: float) -> None:
        self.rig.light.select(wavelength_m)

    def on(self) -> None:
        self.lit = True
        self.rig.light.on()

    def off(self) -> None:
        self.lit = False
        self.rig.light.off()

    def set_exposure(self, exposure_s: float) -> float:
        self.asked_s = exposure_s
        return self.rig.camera.set_exposure(exposure_s)

    def grab(self) -> Frame:
        frame = self.rig.camera.grab()
        self.record.journal(
            "grab",
            step=self.step,
            shot=f"grab {len(self.taken)}",
            lit=self.lit,
            levels_sha256=self.sha256 if self.lit else None,
            asked_s=self.asked_s,
            exposure_s=frame.exposure_s,
            frame_id=frame.frame_id,
            lost_packets=frame.lost_packets,
            file=self.record.keep_frame(f"grab-{frame.frame_id:06d}-{self.step}", frame.counts),
        )
        self.taken.append(frame)
        return frame

    def close(self) -> None:
        self.rig.close()
