"""A GenICam camera, GigE Vision or USB3 Vision, of any maker: single frames by software trigger.

Written on viva-genicam (extra ``genicam``). The library hands out complete frames and is silent about others, so the
stream's counters are read before and after every frame, and incomplete frames are asked for: they come out with their
number of lost packets, and the loop takes them again.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError, DeviceError
from holocal.loop.devices import Finding, Frame
from holocal.records.facts import CameraFacts
from holocal.records.validate import validated
from holocal.units import DEGREE
from rigs import genicam_settings
from rigs.context import DriverContext
from rigs.genicam_discovery import asking, connect, find, serial_of, text_of, viva
from rigs.genicam_table import CameraFile, GenicamTable

if TYPE_CHECKING:
    import viva_genicam

LOGGER = logging.getLogger("holocal.rigs")
US = 1e-6
BLOCK_IDS = 2**16  # GigE Vision 1.x counts blocks in 16 bits and leaves 0 out


@dataclass
class FrameNumbers:
    """Numbers that rise with every fresh frame, made from the camera's block ids, which begin anywhere and wrap.

    A block id that did not rise gives a number that did not rise either, and the loop's gate for stale frames sees it.
    """

    number: int = 0
    _last_block: int | None = None

    def of(self, block: int) -> int:
        """Return the number of the frame with this block id."""
        if self._last_block is None:
            step = 1
        elif max(block, self._last_block) < BLOCK_IDS:  # 16 bits, or 64 that are still small
            step = (block - self._last_block + BLOCK_IDS // 2) % BLOCK_IDS - BLOCK_IDS // 2
        else:
            step = block - self._last_block
        self._last_block = block
        self.number += step
        return self.number


@dataclass
class GenicamCamera:
    """A camera under our control, armed; `bounds` are its exposure's."""

    table: GenicamTable
    bounds: genicam_settings.Bounds
    _camera: viva_genicam.Camera
    _stream: viva_genicam.FrameStream
    _facts: CameraFacts
    _closing: ExitStack = field(default_factory=ExitStack, repr=False)
    _exposure_s: float = 0.0
    numbers: FrameNumbers = field(default_factory=FrameNumbers)

    def describe(self) -> CameraFacts:
        """Return the camera's facts; full scale is that of its pixel format."""
        return self._facts

    def identity(self) -> Mapping[str, Any]:
        """Return the settings that a calibration hangs on."""
        table, camera = self.table, self._camera
        with asking("while its gain was read"):
            gain = next((camera.get(node) for node in ("Gain", "GainRaw") if node in camera.nodes()), "")
        return {
            "pixel_format": table.pixel_format,
            "offset": [table.offset_x, table.offset_y],
            "gain": gain,
        }

    def inspect(self) -> tuple[Finding, ...]:
        """Return what the camera says of its set-up."""
        return genicam_settings.inspect(self._camera, self.table)

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure, within the camera's bounds, and return what it says it made of it."""
        if not np.isfinite(exposure_s) or exposure_s <= 0:
            low, high = self._facts.exposure_min_s, self._facts.exposure_max_s
            raise ConfigError(f"An exposure of {exposure_s} s was asked for.", fix=f"Ask for {low:g} to {high:g} s.")
        wanted_us = min(max(exposure_s / US, self.bounds.lowest_us), self._facts.exposure_max_s / US)
        with asking(f"while its exposure was set to {wanted_us:.6g} us"):
            self._camera.set_float(self.bounds.node, wanted_us)
            self._exposure_s = self._read_exposure()
        return self._exposure_s

    def grab(self) -> Frame:
        """Take one frame, triggered now.

        An incomplete frame is returned with its number of lost packets, zeros where they belong.

        Raises
        ------
        DeviceError
            No frame came in time, the camera is gone or another program's, or it sends frames that nobody asked for.
        """
        stream = self._stream
        with asking("while a frame was taken"):
            self._require_silence()
            before = stream.stats()
            self._camera.trigger_software()
            frame = self._next_frame(before.packets_received)
            after = stream.stats()
            self._require_control()
        lost = after.packets_missing - before.packets_missing + after.frames_lost - before.frames_lost
        if not frame.is_complete:
            lost = max(lost, 1)
        counts = self._counts(frame, lost)
        saturated = float(np.mean(counts >= self._facts.full_scale))
        return Frame(counts, self._exposure_s, self.numbers.of(frame.block_id), saturated, lost)

    def close(self) -> None:
        """End the stream and give the camera up; safe to call twice, and when the camera is gone."""
        self._closing.close()

    def _next_frame(self, packets_before: int) -> viva_genicam.Frame:
        """Return the frame of the last trigger, complete or not."""
        patience_s = self._exposure_s + self.table.timeout_s
        try:
            frame = self._stream.next_frame(round(1e3 * patience_s))
        except viva().TransportError as error:
            packets = self._stream.stats().packets_received - packets_before
            self._require_control()
            hint = (
                "Nothing arrived: check that the firewall lets UDP in, and camera.packet_size against the network's."
                if packets == 0
                else "Packets arrived, but no whole frame: check the cable, or lower camera.packet_size."
            )
            raise DeviceError(
                f"no frame came within {patience_s:.3g} s of the trigger ({packets} packets did): {error}.",
                fix=f"{hint} Then `holocal resume`.",
                measured=packets,
                limit=patience_s,
                code="camera-timeout",
            ) from error
        if frame is None:
            raise DeviceError("the camera ended its stream.", fix="Check its cable and power.", code="camera-lost")
        return frame

    def _require_silence(self) -> None:
        """Raise when a frame waits that nobody triggered: it began before the pattern was shown."""
        extra = 0
        try:
            while self._stream.next_frame(0) is not None:
                extra += 1
        except viva().TransportError:  # nothing waits, as it should be
            pass
        if extra:
            raise DeviceError(
                f"the camera sent {extra} frames that nobody triggered.",
                why="They show what was there before.",
                fix="Set its TriggerMode to On and its TriggerSource to Software, and look who else triggers it.",
                measured=extra,
                limit=0,
                code="camera-untriggered",
            )

    def _require_control(self) -> None:
        """Raise when a GigE Vision camera has forgotten us, or was given to another program."""
        if self._camera.transport == "gige" and self._camera.control_state.value != "Held":
            raise DeviceError(
                "the camera is no longer under our control: it was given to another program, or heard nothing of us "
                "for longer than its heartbeat allows.",
                why="Its exposure and trigger may be another's.",
                fix="Close other programs, check the cable, then `holocal resume`.",
                measured=self._camera.control_state.value,
                limit="Held",
                code="camera-control",
            )

    def _counts(self, frame: viva_genicam.Frame, lost: int) -> NDArray[np.uint16]:
        """Return the frame's counts as the panel's axes have them, zeros where a frame is too damaged to be read."""
        table = self.table
        blank = np.zeros((table.height, table.width), np.uint16)
        if lost and frame.pixel_format != table.pixel_format:  # its first packet is lost: not even its size is known
            return blank
        if frame.pixel_format != table.pixel_format:
            raise DeviceError(
                f"the camera sent {frame.pixel_format}, not {table.pixel_format}.",
                why="Full scale is that of the pixel format.",
                fix="Look who else sets the camera up.",
                measured=frame.pixel_format,
                limit=table.pixel_format,
                code="pixel-format",
            )
        try:
            counts = np.asarray(frame.to_numpy(), np.uint16)
        except viva().ParseError:
            if not lost:
                raise
            return blank
        return np.ascontiguousarray(counts >> table.shift_bits)

    def _read_exposure(self) -> float:
        self._camera.invalidate(self.bounds.node)  # what the camera made of it, not what was written
        return self._camera.get_float(self.bounds.node) * US


def open_camera(table: Mapping[str, Any], context: DriverContext) -> GenicamCamera:
    """Return the camera of a table, under our control, set up and waiting for its first trigger."""
    checked = validated(CameraFile, {"camera": table}, source=context.source).camera
    seen = find(checked, context.source)
    return controlled(connect(seen, checked.interface), checked, context.source)


def controlled(camera: viva_genicam.Camera, table: GenicamTable, source: str) -> GenicamCamera:
    """Return a connected camera as a device of the rig; it is closed again when it cannot be one."""
    with ExitStack() as stack:
        stack.callback(_quietly, camera.close)
        _quietly(camera.acquisition_stop)  # a program that crashed may have left it running
        bounds = genicam_settings.settle(camera, table, source)
        with asking("while its stream was opened", "Check the network card, the firewall and camera.packet_size."):
            stream = camera.stream(iface=table.interface, packet_size=table.packet_size, deliver_incomplete=True)
            stack.callback(_quietly, lambda: stream.__exit__(None, None, None))
            stream.__enter__()
            opened = GenicamCamera(table, bounds, camera, stream, _facts(camera, table, bounds))
            opened.set_exposure(bounds.lowest_us * US)
        opened._closing.callback(stack.pop_all().close)
        return opened
    raise AssertionError  # the stack swallows nothing


def _facts(camera: viva_genicam.Camera, table: GenicamTable, bounds: genicam_settings.Bounds) -> CameraFacts:
    return CameraFacts(
        width=table.width,
        height=table.height,
        field_rad=table.field_rad,
        full_scale=table.full_scale,
        exposure_min_s=bounds.lowest_us * US,
        exposure_max_s=min(bounds.highest_us * US, table.max_exposure_s),
        bits=table.bits,
        vendor=text_of(camera, "DeviceVendorName"),
        model=text_of(camera, "DeviceModelName"),
        serial=serial_of(camera),
        rotation_rad=table.rotation_deg * DEGREE,
        k1=table.k1,
        k2=table.k2,
    )


def _quietly(call: Any) -> None:
    """Call what ends a session; a camera that is gone cannot answer, and the session ends all the same."""
    try:
        call()
    except viva().GenicamError as error:
        LOGGER.info("the camera did not answer when it was let go: %s", error)
