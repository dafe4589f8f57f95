"""What a GenICam camera is set to before a measurement, and what it says of itself afterwards.

Whatever changes counts behind our back is switched off: automatic exposure and gain, gamma, look-up tables, test
pictures, binning, a frame rate that would bound the exposure. Nodes that a camera does not have are passed over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from holocal.errors import ConfigError, RefusedError
from holocal.loop.devices import Finding
from rigs.genicam_discovery import asking, viva
from rigs.genicam_table import GenicamTable

if TYPE_CHECKING:
    import viva_genicam

Value = str | float | bool

# In this order: an automatic mode must be off before what it governs can be written.
FIXED: tuple[tuple[str, Value], ...] = (
    ("AcquisitionMode", "Continuous"),
    ("ExposureMode", "Timed"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("GammaEnable", False),
    ("Gamma", 1.0),
    ("LUTEnable", False),
    ("SharpnessEnable", False),
    ("TestPattern", "Off"),
    ("TestImageSelector", "Off"),
    ("ReverseX", False),
    ("ReverseY", False),
    ("BinningHorizontal", 1.0),
    ("BinningVertical", 1.0),
    ("DecimationHorizontal", 1.0),
    ("DecimationVertical", 1.0),
    ("AcquisitionFrameRateEnable", False),
)
# What must hold of the counts; a camera that cannot be set so is measured wrongly.
REPORTED = ("ExposureAuto", "GainAuto", "BlackLevelAuto", "GammaEnable", "Gamma", "LUTEnable", "TestPattern")
EXPOSURE_NODES = ("ExposureTime", "ExposureTimeAbs")  # microseconds; ExposureTimeRaw has the camera's own units
PACKET_SIZE = 0x0D04  # GigE Vision's register of stream channel 0: its low 16 bits are the size
TEMPERATURE_C = (-10.0, 70.0)  # of a sensor board; beyond it dark current and offset are no longer the calibrated ones


@dataclass(frozen=True)
class Bounds:
    """The exposure node's name and its bounds, microseconds."""

    node: str
    lowest_us: float
    highest_us: float


def settle(camera: viva_genicam.Camera, table: GenicamTable, source: str) -> Bounds:
    """Bring a camera into the state that its table asks for, with one frame per software trigger; return its bounds."""
    nodes = set(camera.nodes())
    with asking("while it was set up"):
        for name, wanted in FIXED:
            if name in nodes:
                _write(camera, name, wanted)
        _set_pixel_format(camera, table, source)
        _set_region(camera, table, source)
        if table.gain_db is not None:
            _set_gain(camera, table.gain_db, source)
        _set_trigger(camera, nodes)
        return _bounds(camera, nodes)


def inspect(camera: viva_genicam.Camera, table: GenicamTable) -> tuple[Finding, ...]:
    """Return what the camera says of its set-up now."""
    nodes = set(camera.nodes())
    findings = []
    with asking("while it was asked for its set-up"):
        camera.invalidate_all()  # what it is now, not what was once written
        wanted: tuple[tuple[str, Value], ...] = (*FIXED, ("PixelFormat", table.pixel_format), ("TriggerMode", "On"))
        for name, value in wanted:
            if name not in nodes or name not in (*REPORTED, "PixelFormat", "TriggerMode"):
                continue
            state = camera.feature_state(name)
            if state.value is None:  # not available in this mode: it does nothing
                continue
            fix = f"Set {name} to {_text(value)} in the camera maker's viewer and save it as the start-up user set."
            ok = _same(state.value, value)
            findings.append(Finding(f"camera {name}", _text(state.value), _text(value), "", ok, fix))
        if camera.transport == "gige":
            size = float(int.from_bytes(camera.read_register(PACKET_SIZE, 4), "big") & 0xFFFF)
            fix = "Lost packets: set camera.packet_size to 1400; 8000 where card and switches pass jumbo frames."
            findings.append(Finding("camera packet size", size, "", "bytes", None, fix))
        if "DeviceTemperature" in nodes:
            celsius = camera.get_float("DeviceTemperature")
            low, high = TEMPERATURE_C
            fix = "Let the camera reach its temperature; give it air."
            findings.append(
                Finding("camera temperature", celsius, f"{low:g} to {high:g}", "deg C", low <= celsius <= high, fix)
            )
    return tuple(findings)


def _write(camera: viva_genicam.Camera, name: str, wanted: Value) -> None:
    """Set a node where the camera has it, lets it be written, and it is not so already."""
    state = camera.feature_state(name)
    if not state.is_available or state.value is None or _same(state.value, wanted) or state.access not in ("RW", "WO"):
        return
    if state.enum_entries is not None and wanted not in state.enum_entries:
        return  # inspect() says so
    camera.set(name, _text(wanted))


def _same(found: Value, wanted: Value) -> bool:
    if isinstance(wanted, str) or isinstance(found, str):
        return found == wanted
    return math.isclose(float(found), float(wanted), rel_tol=1e-6, abs_tol=1e-9)


def _text(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else f"{value:g}"


def _set_pixel_format(camera: viva_genicam.Camera, table: GenicamTable, source: str) -> None:
    offered = camera.available_enum_entries("PixelFormat")
    if table.pixel_format not in offered:
        mono = [name for name in offered if name.startswith("Mono")]
        raise ConfigError(
            f"{source}: camera.pixel_format = {table.pixel_format!r}; the camera has {', '.join(offered)}.",
            fix=f"Set camera.pixel_format to one of {', '.join(mono)}." if mono else "A monochrome camera is needed.",
            measured=table.pixel_format,
            limit=offered,
            code="pixel-format",
        )
    camera.set_enum("PixelFormat", table.pixel_format)


def _set_region(camera: viva_genicam.Camera, table: GenicamTable, source: str) -> None:
    vg = viva()
    wanted = vg.Roi(table.offset_x, table.offset_y, table.width, table.height)
    why = ""
    try:
        camera.set_roi(wanted)
    except vg.GenApiError as error:
        why = f": {error}"
    if why or camera.roi() != wanted:
        raise ConfigError(
            f"{source}: the camera does not take the region of {table.width} x {table.height} pixels from "
            f"({table.offset_x}, {table.offset_y}){why}; it has {camera.roi()}.",
            fix="Choose camera.width, height, offset_x and offset_y within its sensor, in its own steps.",
            code="region",
        )


def _set_gain(camera: viva_genicam.Camera, gain_db: float, source: str) -> None:
    vg = viva()
    try:
        node = camera.set_gain(gain_db)
    except vg.GenApiError as error:
        raise ConfigError(f"{source}: camera.gain_db = {gain_db:g} is refused: {error}.", code="gain") from error
    if node != "Gain":
        raise ConfigError(f"{source}: camera.gain_db: the camera's {node} is not in decibels.", code="gain")


def _set_trigger(camera: viva_genicam.Camera, nodes: set[str]) -> None:
    vg = viva()
    try:
        for selector in camera.available_enum_entries("TriggerSelector") if "TriggerSelector" in nodes else ():
            if selector != "FrameStart":
                camera.disable_trigger(selector)
        camera.enable_trigger("FrameStart", "Software")
    except vg.GenicamError as error:
        raise RefusedError(
            f"the camera cannot take single frames by software trigger: {error}.",
            why="A frame that began before the pattern was shown would be measured.",
            fix='Use a camera whose TriggerSource offers "Software".',
            code="no-trigger",
        ) from error


def _bounds(camera: viva_genicam.Camera, nodes: set[str]) -> Bounds:
    node = next((name for name in EXPOSURE_NODES if name in nodes), None)
    bounds = camera.feature_state(node).range if node is not None else None
    if node is None or bounds is None:
        raise RefusedError(
            f"the camera has no exposure in microseconds with bounds (nodes {', '.join(EXPOSURE_NODES)}).",
            why="Brightness is counts per second of exposure.",
            fix="Use another camera, or its newer firmware.",
            code="no-exposure",
        )
    return Bounds(node, bounds.min, bounds.max)
