"""What of an output's set-up would change a panel's phase, as findings for the pre-flight.

The read-back of a framebuffer sees neither a gamma ramp nor a limited colour range: both act behind it, on the cable.
So every run asks for them. What a virtual output cannot tell is unknown (`ok` None), not failed.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Finding
from rigs.hdmi.edid import Edid
from rigs.hdmi.x_outputs import Output, Saver

RAMP_LIMIT = 0.5  # of 255: below it every level is itself again when rounded to 8 bits; a gamma of 1.01 is 0.93 off
STRAIGHT_ENDS = (65280, 65535)  # of a ramp with the entries 256 i or 257 i: drivers write either
UPRIGHT = 1  # RandR's Rotate_0
ROTATIONS = {1: "normal", 2: "left", 4: "inverted", 8: "right"}

# Property of an output -> values that let an 8-bit level through as it is, and those that are known not to.
PROPERTIES: Mapping[str, tuple[frozenset[str], frozenset[str]]] = {
    "Broadcast RGB": (frozenset({"Full"}), frozenset({"Limited 16:235"})),
    "ColorRange": (frozenset({"Full"}), frozenset({"Limited"})),
    "dither": (frozenset({"off"}), frozenset({"on"})),
    "dithering": (frozenset({"off"}), frozenset({"on"})),
    "dithering mode": (frozenset({"off"}), frozenset({"static 2x2", "dynamic 2x2", "temporal"})),
    "underscan": (frozenset({"off"}), frozenset({"on"})),
    "scaling mode": (frozenset({"None", "Center", "Full", "Full aspect"}), frozenset()),
}


def findings(output: Output, saver: Saver, *, composited: bool, held: bool) -> tuple[Finding, ...]:
    """Return what was found of a panel's output.

    Parameters
    ----------
    composited
        Whether a compositor runs.
    held
        Whether the panel's window holds screen saver and power saving off.
    """
    name = output.place.name
    shown = (output.place.width, output.place.height)
    turned = ROTATIONS.get(output.rotation, f"mirrored ({output.rotation:#x})")
    upright = output.rotation == UPRIGHT
    scaled = upright and shown != output.mode
    found = [
        _finding(
            "mode", _size(output.mode), _size(output.preferred or output.mode), _native(output), _mode_fix(output)
        ),
        _finding(
            "refresh rate",
            round(output.place.refresh_hz, 3),
            "progressive",
            None if output.virtual else not output.interlaced,
            f"Choose a mode that is not interlaced: `xrandr --output {name} --mode ...`.",
            unit="Hz",
        ),
        _finding("rotation", turned, "normal", upright, f"`xrandr --output {name} --rotate normal --reflect normal`"),
        _finding(
            "scale of the desktop", _size(shown), _size(output.mode), not scaled, f"`xrandr --output {name} --scale 1`"
        )
        if upright
        else None,
        _ramp_finding(output),
        *(_property_finding(name, key, value) for key, value in sorted(output.properties.items())),
        _finding(
            "compositor",
            "runs" if composited else "none",
            "none",
            None if composited else True,
            "It may hold a frame back: the read-back waits for it. Better a session without one.",
        ),
        _saver_finding(saver, held=held),
    ]
    return tuple(finding for finding in found if finding is not None)


def ramp_error(ramp: NDArray[np.uint16]) -> float:
    """Return how far a (3, n) gamma ramp is from a straight one, in levels of 255; NaN for one without entries."""
    entries = ramp.shape[1]
    if entries < 2:
        return float("nan")
    full = next((entry for entry in STRAIGHT_ENDS if ramp[:, -1].max() <= entry), 65535)
    return float(np.abs(ramp - np.linspace(0.0, full, entries)).max()) * 255.0 / full


def _native(output: Output) -> bool | None:
    """Return True at the mode that the monitor prefers, None at another: some panels' makers name a wrong one."""
    return True if output.preferred == output.mode else None


def _mode_fix(output: Output) -> str:
    if output.preferred is None:
        return "The monitor names no mode of its own: compare with the panel's data sheet."
    return (
        f"The monitor prefers {_size(output.preferred)}: if that is the panel's size, "
        f"`xrandr --output {output.place.name} --preferred` and set [slm] to it."
    )


def _ramp_finding(output: Output) -> Finding:
    error = ramp_error(output.ramp)
    name = output.place.name
    unknown = output.virtual or not np.isfinite(error)
    return _finding(
        "gamma ramp: distance from a straight one",
        "not known" if unknown else round(error, 2),
        RAMP_LIMIT,
        None if unknown else error <= RAMP_LIMIT,
        f"`xrandr --output {name} --gamma 1:1:1`, and end night light and colour management of {name}: "
        "they change the phase where no read-back sees it.",
        unit="levels of 255",
    )


def _property_finding(name: str, key: str, value: str) -> Finding | None:
    if key == "max bpc":
        return _finding(key, value, "8", int(value) >= 8, f"`xrandr --output {name} --set 'max bpc' 8`", unit="bits")
    if key not in PROPERTIES:
        return None
    good, bad = PROPERTIES[key]
    verdict = True if value in good else False if value in bad else None
    best = sorted(good)[0]
    return _finding(key, value, best, verdict, f"`xrandr --output {name} --set '{key}' '{best}'`")


def _saver_finding(saver: Saver, *, held: bool) -> Finding:
    first_s = min((s for s in (saver.saver_s, saver.power_saving_s) if s), default=0)
    if not saver.powered:
        measured = "the monitor is switched off"
    elif first_s:
        measured = f"after {first_s} s" + (", held off" if held else "")
    else:
        measured = "off"
    ok = saver.powered and (held or not first_s)
    return _finding("screen saver and power saving", measured, "off, or held off", ok, "`xset s off -dpms`")


def _finding(
    title: str, measured: float | str, limit: float | str, ok: bool | None, remedy: str, *, unit: str = ""
) -> Finding:
    return Finding(f"panel output: {title}", measured, limit, unit, ok, remedy)


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def edid_finding(said: Edid, found: Edid | None) -> tuple[Finding, ...]:
    """Return whether the monitor is the one that a rig's file names; nothing where either says nothing."""
    if found is None:
        return ()
    pairs = [(getattr(said, key), getattr(found, key)) for key in ("vendor", "model", "serial")]
    compared = [(wanted, is_there) for wanted, is_there in pairs if wanted and is_there]
    if not compared:
        return ()
    wanted, is_there = (" ".join(part) for part in zip(*compared, strict=True))
    remedy = "Check the panels' cables; or correct vendor, model, serial in [slm] (left out, the monitor's are taken)."
    return (_finding("monitor", is_there, wanted, wanted == is_there, remedy),)
