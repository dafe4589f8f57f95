"""A rig that remembers every frame that its camera gave."""

from __future__ import annotations

from typing import Any

from lab_bench.rig import LabRig

from holocal.loop.devices import Frame
from holocal.loop.record import RunRecord


class WatchedRig:
    """The lab's bench and what its camera gave: the oracle for what a run keeps of it."""

    def __init__(self, rig: LabRig, record: RunRecord) -> None:
        self.rig, self.record = rig, record
        self.slm, self.light, self.camera = rig.slm, rig.light, self
        self.taken: list[Frame] = []

    def facts(self) -> Any:
        return self.rig.facts()

    def truth(self) -> Any:
        return self.rig.truth()

    def begin_step(self, seed: int, step: int) -> None:
        self.rig.begin_step(seed, step)

    def describe(self) -> Any:
        return self.rig.facts().camera

    def set_exposure(self, exposure_s: float) -> float:
        return self.rig.camera.set_exposure(exposure_s)

    def grab(self) -> Frame:
        self.taken.append(self.rig.camera.grab())
        return self.taken[-1]

    def close(self) -> None:
        self.rig.close()
