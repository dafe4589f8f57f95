"""One shot: show, set the exposure, grab, gates. A bad frame is taken again once; light that clips is halved.

When a frame clips more than its shot allows, the exposure is halved and the frame taken again, at most three times;
the halving holds for the rest of the step, so that frames that belong together, dark ones included, keep one
exposure. The next step asks for its exposure afresh: a procedure sees from `Frame.exposure_s` what was used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from holocal.errors import DeviceError, SafetyStop
from holocal.loop import gates
from holocal.loop.devices import Frame, Rig
from holocal.loop.procedure import Shot
from holocal.records.facts import RigFacts

MOST_HALVINGS = 3

Given = TypeVar("Given")
Incident = Callable[[gates.Verdict, Shot, Frame], None]


@dataclass
class Shooter:
    """What takes a rig's frames; counts them, and remembers what is on the panel so nothing is shown twice."""

    rig: Rig
    facts: RigFacts
    incident: Incident
    frames: int = 0
    exposure_factor: float = 1.0
    _shown: str | None = None
    _wavelength_m: float | None = None
    _light: bool | None = None
    _last_id: int | None = None
    _good: Frame | None = field(default=None, repr=False)
    _good_setting: tuple[Any, ...] = ()

    def begin_step(self) -> None:
        """Forget the exposure halvings of the step before."""
        self.exposure_factor = 1.0

    def shoot(self, shot: Shot) -> Frame:
        """Return a frame of `shot` that passed all gates.

        Raises
        ------
        DeviceError
            The frame was bad twice in a row, or a device failed.
        SafetyStop
            Light still clips after three halvings, or at the camera's shortest exposure.
        """
        self._prepare(shot)
        halvings = 0
        asked_s = self._exposure(shot.exposure_s * self.exposure_factor)
        while True:
            frame = self._good_frame(shot)
            clipped = gates.clipped(frame, limit=shot.clip_limit)
            if clipped.ok:
                return frame
            self.incident(clipped, shot, frame)
            lower_s = self._exposure(asked_s / 2) if halvings < MOST_HALVINGS else asked_s
            if lower_s >= asked_s:
                raise self._too_bright(shot, frame, clipped, halvings)
            self.exposure_factor *= lower_s / asked_s
            asked_s = lower_s
            halvings += 1

    def grab(self, shot: Shot) -> Frame:
        """Return one frame of `shot` as it comes, no retake: the pre-flight judges by itself."""
        self._prepare(shot)
        self._exposure(shot.exposure_s)
        frame = self._grab()
        shape = gates.misshapen(frame, self.facts.camera)
        if not shape.ok:
            raise self._unfit(shot, shape)
        self._good, self._good_setting = frame, self._setting(frame)
        return frame

    def _setting(self, frame: Frame) -> tuple[Any, ...]:
        """Return what a frame was taken under: when it changes, the picture must."""
        return self._shown, self._light, frame.exposure_s

    def _prepare(self, shot: Shot) -> None:
        if shot.levels is None:
            self._switch(on=False)
            return
        if self._wavelength_m != shot.wavelength_m:
            guarded(lambda: self.rig.light.select(shot.wavelength_m), "the light source")
            self._wavelength_m = shot.wavelength_m
        self._show(shot.levels)
        self._switch(on=True)

    def _switch(self, *, on: bool) -> None:
        if self._light is not on:
            guarded(self.rig.light.on if on else self.rig.light.off, "the light source")
            self._light = on

    def _show(self, levels: NDArray[np.uint8]) -> None:
        panel = self.facts.slm
        if levels.shape != (panel.height, panel.width) or levels.dtype != np.uint8:
            raise ValueError(
                f"levels of shape {levels.shape} and type {levels.dtype} for {panel.width} x {panel.height}"
            )
        digest = hashlib.sha256(np.ascontiguousarray(levels).data).hexdigest()
        if digest == self._shown:
            return
        for _ in range(2):
            shown = guarded(lambda: self.rig.slm.show(levels), "the SLM")
            if shown.read_back_ok is not False and shown.sha256 == digest:
                self._shown = digest
                return
        raise DeviceError(
            "the SLM shows something else than it was sent, twice.",
            why="Every measurement would be of another pattern.",
            fix="Check scaling, rotation and colour settings of the panel's output.",
            measured=shown.sha256,
            limit=digest,
            code="slm-read-back",
        )

    def _exposure(self, wanted_s: float) -> float:
        camera = self.facts.camera
        bounded = min(max(wanted_s, camera.exposure_min_s), camera.exposure_max_s)
        return guarded(lambda: self.rig.camera.set_exposure(bounded), "the camera")

    def _good_frame(self, shot: Shot) -> Frame:
        failed: gates.Verdict | None = None
        for _ in range(2):
            last_id, good, setting = self._last_id, self._good, self._good_setting
            frame = self._grab()
            failed = gates.first_failure(
                frame,
                self.facts.camera,
                last_id=last_id,
                last=good,
                lit=self._light is True,
                changed=setting != self._setting(frame),
            )
            if failed is None:
                self._good, self._good_setting = frame, self._setting(frame)
                return frame
            self.incident(failed, shot, frame)
        assert failed is not None
        raise self._unfit(shot, failed)

    def _unfit(self, shot: Shot, failed: gates.Verdict) -> DeviceError:
        return DeviceError(
            f"the frames of {shot.label} are unfit ({failed.gate}): {failed.sentence}",
            why="A measurement on such frames would be wrong.",
            fix=f"{failed.fix} Then `holocal resume`.",
            measured=failed.measured,
            limit=failed.limit,
            code=f"gate-{failed.gate}",
        )

    def _grab(self) -> Frame:
        frame = guarded(self.rig.camera.grab, "the camera")
        self.frames += 1
        self._last_id = frame.frame_id
        counts = np.asarray(frame.counts)
        saturated = float(np.count_nonzero(counts >= self.facts.camera.full_scale)) / max(counts.size, 1)
        return replace(frame, saturated_fraction=max(saturated, frame.saturated_fraction))

    def _too_bright(self, shot: Shot, frame: Frame, clipped: gates.Verdict, halvings: int) -> SafetyStop:
        least = self.facts.camera.exposure_min_s
        lowest = frame.exposure_s <= least * (1 + 1e-6)
        how = "the camera's shortest exposure" if lowest else f"the exposure after {halvings} halvings"
        return SafetyStop(
            f"{clipped.measured:.2%} of the pixels of {shot.label} are at full scale at "
            f"{1e3 * frame.exposure_s:.4g} ms, {how}; at most {clipped.limit:.2%} may be.",
            why="Clipped light is not measured, and may harm the sensor.",
            fix="Put a neutral density filter in the beam or lower the laser's power by hand; then `holocal resume`.",
            measured=clipped.measured,
            limit=clipped.limit,
            code="too-bright",
        )


def guarded(call: Callable[[], Given], device: str) -> Given:
    """Return what a device's call returns; a system error of it becomes a `DeviceError`."""
    try:
        return call()
    except OSError as error:  # TimeoutError and ConnectionError are OSErrors
        raise DeviceError(
            f"{device} failed: {error or type(error).__name__}.",
            why="The run cannot go on without it.",
            fix="Check its cable and power; then `holocal resume`.",
            code="device-lost",
        ) from error
