"""What an X server says of its lit outputs, by RandR, DPMS and MIT-SCREEN-SAVER (python-xlib).

python-xlib raises where Xlib would end the process, and opens a connection of its own for every question.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError, DeviceError
from rigs.hdmi.edid import Edid, read_edid
from rigs.hdmi.window import Place

INTERLACED = 1 << 4  # RandR's mode flag
MOST_PROPERTY_WORDS = 128  # of 32 bits: an EDID with three extensions
GET_OUTPUT_PROPERTY = 15  # RandR's request


@dataclass(frozen=True)
class Output:
    """One lit output: its place, its mode, and what stands between its framebuffer and its cable."""

    place: Place
    mode: tuple[int, int]
    preferred: tuple[int, int] | None
    interlaced: bool
    rotation: int
    ramp: NDArray[np.uint16] = field(repr=False)  # (3, n): red, green, blue
    properties: Mapping[str, str]
    edid: Edid | None
    virtual: bool


@dataclass(frozen=True)
class Saver:
    """Screen saver and power saving: seconds until they come (0: never), and whether the monitor is powered."""

    saver_s: int
    power_saving_s: int
    powered: bool


def on_x11() -> bool:
    """Return whether SDL would take an X server here, as it does wherever there is one."""
    wanted = os.environ.get("SDL_VIDEODRIVER", "x11")
    return sys.platform not in ("win32", "darwin") and bool(os.environ.get("DISPLAY")) and wanted in ("", "x11")


def outputs() -> tuple[Output, ...]:
    """Return the lit outputs of the X server that DISPLAY names."""
    with _connected() as display:
        return tuple(_outputs(display))


def state(name: str) -> tuple[Output, Saver, bool]:
    """Return an output, the server's savers, and whether a compositor runs; `DeviceError` when it is not lit."""
    with _connected() as display:
        found = {output.place.name: output for output in _outputs(display)}
        if name not in found:
            raise DeviceError(
                f"output {name} is off; lit are {', '.join(found) or 'none'}.",
                fix="Check the panel's cable and power.",
                code="monitor-changed",
            )
        owner = display.get_selection_owner(display.get_atom(f"_NET_WM_CM_S{display.get_default_screen()}"))
        return found[name], _saver(display), bool(owner)


@contextmanager
def _connected() -> Iterator[Any]:
    """Yield a connection of python-xlib, which raises where Xlib would end the process."""
    try:
        from Xlib import display as x_display
        from Xlib import error as x_error
    except ImportError as error:
        raise ConfigError(
            f"the outputs of an X server are read with the package python-xlib: {error}.",
            fix='Install it with `pip install "holocal[hdmi]"`.',
            code="missing-package",
        ) from error
    try:
        display = x_display.Display()
        try:
            yield display
        finally:
            display.close()
    except (x_error.DisplayError, x_error.ConnectionClosedError, OSError) as error:
        raise DeviceError(
            f"the X server {os.environ.get('DISPLAY', '')} does not answer: {error}.",
            why="Nothing is known of the panel's output.",
            fix="Check DISPLAY and the permission to use it (xauth).",
            code="display-lost",
        ) from error


def _outputs(display: Any) -> Iterator[Output]:
    root = display.screen().root
    resources = root.xrandr_get_screen_resources()
    modes = {mode.id: mode for mode in resources.modes}
    nested = display.has_extension("XWAYLAND")  # a Wayland session's own server: what it says is emulated
    for identifier in resources.outputs:
        about = display.xrandr_get_output_info(identifier, resources.config_timestamp)
        if not about.crtc:
            continue
        crtc = display.xrandr_get_crtc_info(about.crtc, resources.config_timestamp)
        mode = modes[crtc.mode]
        refresh_hz = mode.dot_clock / (mode.h_total * mode.v_total) if mode.h_total and mode.v_total else 0.0
        preferred = modes[about.modes[0]] if about.num_preferred else None
        ramp = display.xrandr_get_crtc_gamma(about.crtc)
        properties = dict(_properties(display, identifier))
        yield Output(
            place=Place(about.name, crtc.x, crtc.y, crtc.width, crtc.height, refresh_hz),
            mode=(mode.width, mode.height),
            preferred=(preferred.width, preferred.height) if preferred else None,
            interlaced=bool(mode.flags & INTERLACED),
            rotation=crtc.rotation,
            ramp=np.array([ramp.red, ramp.green, ramp.blue], np.uint16),
            properties={key: value for key, value in properties.items() if isinstance(value, str)},
            edid=read_edid(raw) if isinstance(raw := properties.get("EDID"), bytes) else None,
            virtual=nested or not mode.dot_clock,
        )


def _properties(display: Any, output: int) -> Iterator[tuple[str, str | bytes]]:
    """Yield an output's properties: names of atoms, decimal numbers, and what is neither as bytes (the EDID)."""
    ask = _property_request()
    for atom in display.xrandr_list_output_properties(output).atoms:
        reply = ask(
            display=display.display,
            opcode=display.display.get_extension_major("RANDR"),
            output=output,
            property=atom,
            type=0,  # any
            long_offset=0,
            long_length=MOST_PROPERTY_WORDS,
            delete=False,
            pending=False,
        )
        width, values = reply.value if reply.value is not None else (0, [])
        if width == 8:
            yield display.get_atom_name(atom), bytes(values)
        elif len(values) == 1:
            is_atom = display.get_atom_name(reply.property_type) == "ATOM"
            yield display.get_atom_name(atom), display.get_atom_name(values[0]) if is_atom else str(values[0])


def _property_request() -> Any:
    """Return RandR's request for a property; python-xlib 0.33's own reads 32-bit values as bytes."""
    from Xlib.protocol import rq

    class GetOutputProperty(rq.ReplyRequest):  # type: ignore[misc]
        _request = rq.Struct(
            rq.Card8("opcode"),
            rq.Opcode(GET_OUTPUT_PROPERTY),
            rq.RequestLength(),
            rq.Card32("output"),
            rq.Card32("property"),
            rq.Card32("type"),
            rq.Card32("long_offset"),
            rq.Card32("long_length"),
            rq.Bool("delete"),
            rq.Bool("pending"),
            rq.Pad(2),
        )
        _reply = rq.Struct(
            rq.ReplyCode(),
            rq.Format("value", 1),
            rq.Card16("sequence_number"),
            rq.ReplyLength(),
            rq.Card32("property_type"),
            rq.Card32("bytes_after"),
            rq.LengthOf("value", 4),
            rq.Pad(12),
            rq.PropertyData("value"),
        )

    return GetOutputProperty


def _saver(display: Any) -> Saver:
    saver_s = int(display.get_screen_saver().timeout)
    if not display.has_extension("DPMS"):
        return Saver(saver_s, 0, powered=True)
    info, times = display.dpms_info(), display.dpms_get_timeouts()
    waits = [times.standby_timeout, times.suspend_timeout, times.off_timeout]
    first_s = min((int(wait) for wait in waits if wait), default=0)
    return Saver(saver_s, first_s if info.state else 0, powered=not info.state or info.power_level == 0)
