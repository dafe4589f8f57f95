"""A phase panel that is a monitor of this computer: HDMI or DisplayPort, one level per pixel, 8 bits.

The table ``[slm]`` of a rig's file::

    [slm]
    driver = "hdmi"
    monitor = "HDMI-1"        # the output's name; `holocal doctor` lists them
    width = 3840
    height = 2160             # the monitor's mode must be this
    pitch_um = 3.74
    packing = "red"           # level in red, green and blue 0; "grey": in all three
    verify = "always"         # read every pattern back, "first" only the first one, or "never"

A rig has one thread: SDL refuses calls from another than the one that opened the panel.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from holocal.errors import ConfigError, DeviceError
from holocal.loop.devices import Finding, Shown
from holocal.records.facts import SlmFacts
from holocal.records.rig_model import Pixels, Table
from holocal.records.validate import closest, validated
from rigs.context import DriverContext
from rigs.display_state import edid_finding, findings
from rigs.hdmi import x_outputs
from rigs.hdmi.edid import Edid
from rigs.hdmi.read_back import Reader
from rigs.hdmi.window import PanelWindow, Place, require_display, sdl_places

LOGGER = logging.getLogger("holocal.rigs")
UM = 1e-6

# A pattern is on the panel at the next refresh at the latest, is scanned out during one, and rests in the panel's
# controller for one or two more; then the liquid crystal turns (10 to 30 ms). 100 ms at 60 Hz; measure yours.
SETTLE_FRAMES = 4
CRYSTAL_S = 0.033
USUAL_REFRESH_HZ = 60.0  # where the refresh rate is not known

# A compositor may show a pattern a few frames late; what still differs after this is something else.
READ_BACK_PATIENCE_S = 0.1

READABLE = ("x11", "windows", "cocoa")  # a Wayland session lets no program read the screen

# What a level is multiplied by, and so where it stands in 0x00RRGGBB.
PACKINGS = {"red": np.uint32(0x010000), "grey": np.uint32(0x010101)}


class HdmiTable(Table):
    """``[slm]`` with ``driver = "hdmi"``.

    `vendor`, `model` and `serial` stand in for what the monitor's EDID does not say; `inspect` holds them
    against what it says.
    """

    driver: Literal["hdmi"] = "hdmi"
    monitor: str = Field(min_length=1)
    width: Pixels
    height: Pixels
    pitch_um: Annotated[float, Field(gt=0.0, le=1000.0)]
    bits: Annotated[int, Field(ge=1, le=8)] = 8
    packing: Literal["red", "grey"] = "red"
    settle_ms: Annotated[float, Field(ge=0.0, le=10000.0)] | None = None
    verify: Literal["always", "first", "never"] = "always"
    vendor: str = ""
    model: str = ""
    serial: str = ""


def open_slm(table: Mapping[str, Any], context: DriverContext) -> HdmiSlm:
    """Return the panel of a rig's ``[slm]`` table, opened and blank.

    Raises
    ------
    ConfigError
        A key is wrong, there is no such monitor, or its mode is not the panel's size.
    DeviceError
        The display cannot be opened, or the window does not cover the monitor.
    """
    checked = validated(HdmiTable, table, source=f"{context.source}, [slm]")
    return HdmiSlm(checked, _chosen(checked, context.source))


def discover() -> tuple[Place, ...]:
    """Return the monitors of this computer, without opening a window; empty where there is no display."""
    try:
        require_display()
    except ConfigError:
        return ()
    return _places()


class HdmiSlm:
    """The panel, as the loop sees it: `describe`, `show`, `blank`, `inspect`, `close`."""

    def __init__(self, table: HdmiTable, place: Place) -> None:
        self._table, self._place = table, place
        self._edid = _edid(place.name)
        self._settle_s = _settle_s(table, place)
        self._verified = False
        self._reader: Reader | None = None
        self._window = PanelWindow(place)
        try:
            if table.verify != "never" and self._window.driver in READABLE:
                self._reader = Reader(place.x, place.y, place.width, place.height)
            self.blank()
        except BaseException:
            self.close()
            raise

    def describe(self) -> SlmFacts:
        """Return the panel's facts."""
        table, edid = self._table, self._edid or Edid("", "", "")
        return SlmFacts(
            table.width,
            table.height,
            table.pitch_um * UM,
            table.bits,
            edid.vendor or table.vendor,
            edid.model or table.model,
            edid.serial or table.serial,
        )

    def identity(self) -> dict[str, str]:
        """Return what a calibration hangs on beyond the facts: how a level is put into a pixel."""
        return {"packing": self._table.packing}

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        """Show (height, width) levels; returns when they were read back and have settled."""
        self._check(levels)
        factor = PACKINGS[self._table.packing]
        self._window.present(lambda pixels: _pack(levels, factor, pixels))
        since = time.monotonic()
        read_back = None
        if self._reader is not None and not (self._verified and self._table.verify == "first"):
            read_back, since = self._read_back(self._reader, levels, factor)
            self._verified = read_back
        time.sleep(max(0.0, since + self._settle_s - time.monotonic()))
        return Shown(hashlib.sha256(np.ascontiguousarray(levels).data).hexdigest(), read_back)

    def blank(self) -> None:
        """Show level 0 everywhere. On a closed panel, or one whose display is lost, there is nothing to blank."""
        try:
            if self._window.is_open:
                self._window.present(lambda pixels: pixels.fill(0))
        except DeviceError as error:
            if self._window.is_open:
                raise
            LOGGER.warning("the panel could not be blanked: %s", error)

    def inspect(self) -> tuple[Finding, ...]:
        """Return how the panel's output is set up; unknown, not failed, where the system does not say."""
        if self._window.driver != "x11":
            title = f"panel output: gamma ramp, rotation, mode under {self._window.driver}"
            remedy = "This system does not say: compare levels with the camera, and switch night light and HDR off."
            return (Finding(title, "not known", "as they are", "", None, remedy),)
        output, saver, composited = x_outputs.state(self._place.name)
        found = findings(output, saver, composited=composited, held=self._window.holds_screen_saver)
        said = Edid(self._table.vendor, self._table.model, self._table.serial)
        return (*found, *edid_finding(said, output.edid))

    def close(self) -> None:
        """Blank the panel and let its monitor go; safe to call twice."""
        try:
            self.blank()
        finally:
            self._window.close()
            if self._reader is not None:
                self._reader.close()
                self._reader = None

    def _check(self, levels: NDArray[np.uint8]) -> None:
        table = self._table
        if levels.dtype != np.uint8 or levels.shape != (table.height, table.width):
            raise DeviceError(
                f"the panel takes {table.width} x {table.height} levels of 8 bits; it was given {levels.dtype} of "
                f"shape {levels.shape}.",
                fix="Render the frame for this rig.",
            )
        highest = int(levels.max(initial=0)) if table.bits < 8 else 0
        if highest >= 2**table.bits:
            raise DeviceError(
                f"level {highest} was sent to a panel of {table.bits} bits.",
                measured=highest,
                limit=2**table.bits - 1,
            )

    def _read_back(self, reader: Reader, levels: NDArray[np.uint8], factor: np.uint32) -> tuple[bool, float]:
        """Return whether the screen has the levels, and the latest time at which it can have got them."""
        wanted = np.empty(levels.shape, np.uint32)
        _pack(levels, factor, wanted)
        deadline = time.monotonic() + READ_BACK_PATIENCE_S
        while True:
            asked = time.monotonic()
            if np.array_equal(reader.pixels(), wanted):
                return True, asked
            if asked > deadline:
                return False, asked
            time.sleep(0.01)


def _pack(levels: NDArray[np.uint8], factor: np.uint32, out: NDArray[np.uint32]) -> None:
    """Write levels as pixels 0x00RRGGBB: 0.8 ms at 1920 x 1200, thirty times as fast as channel by channel."""
    np.multiply(levels, factor, out=out, dtype=np.uint32)


def _settle_s(table: HdmiTable, place: Place) -> float:
    if table.settle_ms is not None:
        return table.settle_ms * 1e-3
    return SETTLE_FRAMES / (place.refresh_hz or USUAL_REFRESH_HZ) + CRYSTAL_S


def _places() -> tuple[Place, ...]:
    if x_outputs.on_x11():
        return tuple(output.place for output in x_outputs.outputs())
    return sdl_places()


def _edid(name: str) -> Edid | None:
    if not x_outputs.on_x11():
        return None
    return next((output.edid for output in x_outputs.outputs() if output.place.name == name), None)


def _chosen(table: HdmiTable, source: str) -> Place:
    """Return the monitor that the table names, if its mode is the panel's size."""
    require_display()
    known = {place.name: place for place in _places()}
    if table.monitor not in known:
        listed = ", ".join(f"{p.name} ({p.width} x {p.height})" for p in known.values()) or "none"
        raise ConfigError(
            f"{source}: slm.monitor = {table.monitor!r} is not there.{closest(table.monitor, known)}",
            why="The pattern would go to another monitor.",
            fix=f"Monitors that are there: {listed}. Check the panel's cable and power.",
            measured=table.monitor,
            limit=list(known),
            code="unknown-monitor",
        )
    place = known[table.monitor]
    if (place.width, place.height) != (table.width, table.height):
        raise ConfigError(
            f"{source}: slm.width x height = {table.width} x {table.height}; monitor {place.name} shows "
            f"{place.width} x {place.height}.",
            why="A pattern that is scaled or cut is another hologram.",
            fix=f"Set the monitor's mode (`xrandr --output {place.name} --mode {table.width}x{table.height}`), "
            "or correct [slm].",
            measured=[place.width, place.height],
            limit=[table.width, table.height],
            code="panel-size",
        )
    return place
