"""One shot: show, set the exposure, grab, gates. A bad frame is taken again once; light that clips is halved.

When a frame clips more than its shot allows, the exposure is halved and the frame taken again, at most three times;
the halving holds for the rest of the step, so that frames that belong together, dark ones included, keep one
exposure. The next step asks for its exposure afresh: a procedure sees from `Frame.exposure_s` what was used.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from holocal.errors import DeviceError, SafetyStop
from holocal.loop import gates
from holocal.loop.devices import Frame, Rig
from holocal.loop.procedure import Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts

LOGGER = logging.getLogger("holocal.loop")
MOST_HALVINGS = 3
EXPOSURE_EXCESS = 1.01  # a camera rounds up to its own step, a line's time: 0.1 % of a millisecond or so
SHOW_AGAIN = ("unchanged", "unlit")  # gates that a pattern trips which never arrived

Given = TypeVar("Given")
Incident = Callable[[gates.Verdict, Shot, Frame], None]


@dataclass(frozen=True)
class Taken:
    """A frame as the camera gave it, fit or not, and under what it was taken."""

    shot: Shot
    frame: Frame
    asked_s: float
    lit: bool
    levels_sha256: str | None


@dataclass
class Shooter:
    """What takes a rig's frames; counts them, and remembers what is on the panel so nothing is shown twice."""

    rig: Rig
    facts: RigFacts
    incident: Incident
    reference: Reference | None = None
    taken: Callable[[Taken], None] | None = None  # told of every frame, retakes and the pre-flight's included
    frames: int = 0
    exposure_factor: float = 1.0
    _shown: str | None = None
    _wavelength_m: float | None = None
    _asked_s: float = 0.0
    _light: bool | None = None
    _last_id: int | None = None
    _good: Frame | None = field(default=None, repr=False)
    _good_setting: tuple[Any, ...] = ()
    _picture: Frame | None = field(default=None, repr=False)  # the last good frame with light
    _picture_of: tuple[str | None, float | None] = (None, None)  # its pattern and wavelength

    @property
    def last_frame(self) -> Frame | None:
        """The last frame that was good, or that the pre-flight took."""
        return self._good

    def light_off(self) -> None:
        """Switch the light off, whatever it was."""
        self._light = None
        self._switch(on=False)

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

    def frame(self, shot: Shot) -> Frame:
        """Return a frame of `shot` that passed every gate but the one for clipping; a bad one is taken again once."""
        self._prepare(shot)
        self._exposure(shot.exposure_s)
        return self._good_frame(shot)

    def grab(self, shot: Shot) -> Frame:
        """Return one frame of `shot` as it comes, no retake: the pre-flight judges by itself."""
        self._prepare(shot)
        self._exposure(shot.exposure_s)
        frame = self._grab(shot)
        shape = gates.misshapen(frame, self.facts.camera)
        if not shape.ok:
            self.incident(shape, shot, frame)
            raise self._unfit(shot, shape)
        self._keep(frame)
        return frame

    def read_back(self, levels: NDArray[np.uint8]) -> bool | None:
        """Show levels, twice if need be, and return whether the panel says that they arrived; None: it cannot say."""
        panel = self.facts.slm
        if levels.shape != (panel.height, panel.width) or levels.dtype != np.uint8:
            raise ValueError(
                f"levels of shape {levels.shape} and type {levels.dtype} for {panel.width} x {panel.height}"
            )
        digest = hashlib.sha256(np.ascontiguousarray(levels).data).hexdigest()
        self._shown = None
        for number in range(2):
            if number:
                LOGGER.warning("the SLM shows something else than it was sent: shown again")
            shown = guarded(lambda: self.rig.slm.show(levels), "the SLM")
            if shown.read_back_ok is not False and shown.sha256 == digest:
                self._shown = digest
                return shown.read_back_ok
        return False

    def _keep(self, frame: Frame) -> None:
        self._good, self._good_setting = frame, self._setting(frame)
        if self._light:
            self._picture, self._picture_of = frame, (self._shown, self._wavelength_m)

    def _setting(self, frame: Frame) -> tuple[Any, ...]:
        """Return what a frame was taken under: when it changes, the picture must."""
        return self._shown, self._light, self._wavelength_m, frame.exposure_s

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
        digest = hashlib.sha256(np.ascontiguousarray(levels).data).hexdigest()
        if digest == self._shown:
            return
        if self.read_back(levels) is False:
            raise DeviceError(
                "the SLM shows something else than it was sent, twice.",
                why="Every measurement would be of another pattern.",
                fix="Check scaling, rotation and colour settings of the panel's output; then `holocal resume`.",
                measured="something else",
                limit=digest,
                code="slm-read-back",
            )

    def _exposure(self, wanted_s: float) -> float:
        """Set an exposure within the camera's bounds and return what it made of it; the one place that asks for one.

        The bounds are the facts': the camera's own, and the rig's safety.max_exposure_s where that is less.
        """
        camera = self.facts.camera
        bounded = min(max(camera.exposure_min_s, wanted_s), camera.exposure_max_s)  # in this order NaN is the shortest
        self._asked_s = bounded
        used_s = guarded(lambda: self.rig.camera.set_exposure(bounded), "the camera")
        if used_s > camera.exposure_max_s * EXPOSURE_EXCESS:
            raise SafetyStop(
                f"the camera made {used_s:.6g} s of an exposure of {bounded:.6g} s; {camera.exposure_max_s:g} s is the "
                "longest that is allowed.",
                why="More light than allowed would fall on the sensor.",
                fix="Check the camera's automatic exposure, and safety.max_exposure_s in the rig's file.",
                measured=used_s,
                limit=camera.exposure_max_s,
                code="exposure-ceiling",
            )
        return used_s

    def _good_frame(self, shot: Shot) -> Frame:
        failed: gates.Verdict | None = None
        for _ in range(2):
            if failed is not None and failed.gate in SHOW_AGAIN and shot.levels is not None:
                self._shown = self._light = None
                self._prepare(shot)
            last_id = self._last_id
            frame = self._grab(shot)
            failed = gates.first_failure(frame, self.facts.camera, self._surroundings(shot, frame, last_id))
            if failed is None:
                self._keep(frame)
                return frame
            self.incident(failed, shot, frame)
        assert failed is not None
        raise self._unfit(shot, failed)

    def _surroundings(self, shot: Shot, frame: Frame, last_id: int | None) -> gates.Surroundings:
        pattern, wavelength_m = self._picture_of
        another = pattern != self._shown and wavelength_m == self._wavelength_m
        return gates.Surroundings(
            last_id=last_id,
            last=self._good,
            lit=self._light is True,
            changed=self._good_setting != self._setting(frame),
            other=self._picture if another else None,
            fresh=shot.fresh,
            reference=self.reference,
        )

    def _unfit(self, shot: Shot, failed: gates.Verdict) -> DeviceError:
        return DeviceError(
            f"the frames of {shot.label} are unfit ({failed.gate}): {failed.sentence}",
            why="A measurement on such frames would be wrong.",
            fix=f"{failed.fix} Then `holocal resume`.",
            measured=failed.measured,
            limit=failed.limit,
            code=f"gate-{failed.gate}",
        )

    def _grab(self, shot: Shot) -> Frame:
        frame = guarded(self.rig.camera.grab, "the camera")
        if self.taken is not None:
            lit = self._light is True
            self.taken(Taken(shot, frame, self._asked_s, lit, self._shown if lit else None))
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
