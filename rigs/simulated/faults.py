"""Faults on demand: devices round devices that go wrong when the rig's file says so.

They know the protocols of `holocal.loop.devices` and nothing of what they are put round, so they suit any rig. What
goes wrong is said in `holocal.records.fault_model.FaultTable`; a rig without faults is not touched.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError
from holocal.loop.devices import Camera, Finding, Frame, Inspectable, Light, Repeatable, Rig, Shown, Slm
from holocal.records.facts import CameraFacts, RigFacts, SlmFacts
from holocal.records.fault_model import FaultTable

CONTAINER_BITS = 16  # of a pixel in memory
PACKET_BYTES = 1500  # of an Ethernet frame without jumbo frames


@dataclass
class _Drill:
    """What the three devices know of each other: the counts, the light, a pattern that is still on its way."""

    faults: FaultTable
    grabs: int = 0
    shows: int = 0
    lit: bool = False
    dark_level: float = 0.0  # counts, of the last frame without light
    coming: NDArray[np.uint8] | None = None
    frames_to_wait: int = 0


def with_faults(rig: Rig, faults: FaultTable) -> Rig:
    """Return `rig` with these faults; the rig itself where there are none."""
    if not faults.active():
        return rig
    if faults.left_justified and rig.camera.describe().bits > CONTAINER_BITS - 2:
        raise ConfigError(
            f"faults.left_justified: counts of {rig.camera.describe().bits} bits fill {CONTAINER_BITS} bits already.",
            fix="Use a camera of at most 14 bits (camera.bits) for this drill.",
        )
    return FaultyRig(rig, _Drill(faults))


@dataclass
class FaultySlm:
    """An SLM that goes wrong."""

    _slm: Slm
    _drill: _Drill

    def describe(self) -> SlmFacts:
        """Return the panel's facts."""
        return self._slm.describe()

    def inspect(self) -> tuple[Finding, ...]:
        """Return the panel's findings and the gamma ramp of its output, as an X server would tell it."""
        found = self._slm.inspect() if isinstance(self._slm, Inspectable) else ()
        gamma = self._drill.faults.output_gamma
        if gamma == 1.0:
            return found
        remedy = (
            "Set the output's gamma ramp to the identity (`xrandr --gamma 1:1:1`); end night light and colour profiles."
        )
        return (*found, Finding("gamma of the output", gamma, 1.0, "", False, remedy))

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        """Show levels, or something else."""
        drill, faults = self._drill, self._drill.faults
        drill.shows += 1
        if _since(faults.lose_slm_from_show, drill.shows):
            raise ConnectionError("the panel does not answer")
        wanted = hashlib.sha256(np.ascontiguousarray(levels).data).hexdigest()
        if drill.shows == faults.ignore_show_at or _since(faults.ignore_shows_from, drill.shows):
            return Shown(wanted, {"lies": True, "honest": False, "none": None}[faults.read_back])
        if faults.latency_frames:
            drill.coming, drill.frames_to_wait = levels.copy(), faults.latency_frames
            shown = Shown(wanted, read_back_ok=True)
        else:
            shown = replace(self._slm.show(self.after_gamma(levels)), sha256=wanted)
        return replace(shown, read_back_ok=None) if faults.read_back == "none" else shown

    def after_gamma(self, levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return what reaches the panel."""
        gamma = self._drill.faults.output_gamma
        if gamma == 1.0:
            return levels
        top = 2 ** self._slm.describe().bits - 1
        ramp = np.rint(top * (np.arange(top + 1) / top) ** gamma).astype(np.uint8)
        return np.asarray(ramp[levels])

    def arrive(self) -> None:
        """Let a pattern that is on its way reach the panel when its time has come; a camera's grab is the clock."""
        drill = self._drill
        if drill.coming is None:
            return
        if drill.frames_to_wait > 0:
            drill.frames_to_wait -= 1
            return
        self._slm.show(self.after_gamma(drill.coming))
        drill.coming = None

    def blank(self) -> None:
        """Show level 0 everywhere, at once: what makes a bench safe is not delayed by a drill."""
        if _since(self._drill.faults.lose_slm_from_show, self._drill.shows):
            raise ConnectionError("the panel does not answer")
        self._drill.coming = None
        self._slm.blank()


@dataclass
class FaultyLight:
    """A light that goes out, silently."""

    _light: Light
    _drill: _Drill

    def select(self, wavelength_m: float) -> None:
        """Choose the laser line nearest to a wavelength."""
        self._light.select(wavelength_m)

    def on(self) -> None:
        """Switch the light on."""
        self._drill.lit = True
        self._light.on()

    def off(self) -> None:
        """Switch the light off."""
        self._drill.lit = False
        self._light.off()


@dataclass
class FaultyCamera:
    """A camera that goes wrong, and the light's faults, which only frames can show."""

    _camera: Camera
    _slm: FaultySlm
    _light: Light
    _drill: _Drill
    _last: Frame | None = None

    def describe(self) -> CameraFacts:
        """Return what the camera says of itself: another serial number when it was swapped."""
        facts, faults = self._camera.describe(), self._drill.faults
        if faults.swapped_camera:
            facts = replace(facts, serial=f"{facts.serial}-other")
        return replace(facts, full_scale=2**CONTAINER_BITS - 1) if faults.left_justified else facts

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure and return what the camera made of it."""
        return self._camera.set_exposure(exposure_s)

    def grab(self) -> Frame:
        """Take one frame, or what comes instead."""
        drill, faults = self._drill, self._drill.faults
        drill.grabs += 1
        number = drill.grabs
        if _since(faults.lose_camera_from_grab, number):
            raise ConnectionError("the camera does not answer")
        if number == faults.dropped_at_grab:
            raise TimeoutError("no frame within the exposure and 2 s")
        self._slm.arrive()
        if self._last is not None:
            if number == faults.stale_at_grab or _since(faults.stale_from_grab, number):
                return self._last
            if _since(faults.repeated_from_grab, number):
                return replace(self._last, frame_id=number)
        if _since(faults.lose_light_from_grab, number):
            self._light.off()
        self._last = replace(self._spoiled(self._lit(self._camera.grab())), frame_id=number)
        return self._last

    def _lit(self, frame: Frame) -> Frame:
        """Return the frame in the light as it is at this grab."""
        drill, faults = self._drill, self._drill.faults
        if not drill.lit:
            drill.dark_level = float(np.median(frame.counts))
            return frame
        brighter = (1.0 + faults.drift_per_grab) ** (drill.grabs - 1)
        if _since(faults.saturate_from_grab, drill.grabs):
            brighter *= faults.saturate_factor
        if brighter == 1.0:
            return frame
        full_scale = self._camera.describe().full_scale
        counts = drill.dark_level + brighter * (frame.counts.astype(np.float64) - drill.dark_level)
        return _with_counts(frame, np.clip(np.rint(counts), 0, full_scale).astype(np.uint16), full_scale)

    def _spoiled(self, frame: Frame) -> Frame:
        """Return the frame as it comes over the cable."""
        faults, number, counts = self._drill.faults, self._drill.grabs, frame.counts
        flipped = {"none": counts, "x": counts[:, ::-1], "y": counts[::-1], "xy": counts[::-1, ::-1]}[faults.mirror]
        frame = replace(frame, counts=np.ascontiguousarray(flipped))
        if faults.left_justified:
            shift = CONTAINER_BITS - self._camera.describe().bits
            frame = _with_counts(frame, np.left_shift(frame.counts, shift), 2**CONTAINER_BITS - 1)
        rows = frame.counts.shape[0]
        if number == faults.truncated_at_grab:
            counts = frame.counts.copy()
            counts[rows // 2 :] = 0
            return replace(frame, counts=counts, lost_packets=-(-counts[rows // 2 :].nbytes // PACKET_BYTES))
        if number == faults.short_at_grab:
            return replace(frame, counts=frame.counts[: rows // 2])
        if number == faults.nan_at_grab:
            return replace(frame, counts=np.full(frame.counts.shape, np.nan))  # no uint16, as that driver's is none
        return frame


class FaultyRig:
    """A rig whose devices go wrong; what it is and what is true of it stay the rig's own."""

    def __init__(self, rig: Rig, drill: _Drill) -> None:
        self._rig = rig
        self.slm = FaultySlm(rig.slm, drill)
        self.light = FaultyLight(rig.light, drill)
        self.camera = FaultyCamera(rig.camera, self.slm, rig.light, drill)

    def facts(self) -> RigFacts:
        """Return the rig's facts, with what its camera now says of itself."""
        return replace(self._rig.facts(), camera=self.camera.describe())

    def begin_step(self, seed: int, step: int) -> None:
        """Start the noise of a step anew, where the rig can."""
        if isinstance(self._rig, Repeatable):
            self._rig.begin_step(seed, step)

    def truth(self) -> dict[str, Any] | None:
        """Return what a simulated rig alone can know."""
        return self._rig.truth()

    def close(self) -> None:
        """Close the rig."""
        self._rig.close()


def _since(first: int | None, number: int) -> bool:
    return first is not None and number >= first


def _with_counts(frame: Frame, counts: NDArray[np.uint16], full_scale: int) -> Frame:
    return replace(frame, counts=counts, saturated_fraction=float(np.mean(counts >= full_scale)))
