"""Units at the edges: SI inside, degrees, millimetres and nanometres in files and reports."""

from __future__ import annotations

from math import pi

DEGREE = pi / 180.0
MM = 1e-3
UM = 1e-6
NM = 1e-9

# What a name ends with, and the unit that it then bears. Tangents are numbers.
_SUFFIXES = {
    "rad": "rad", "deg": "deg", "px": "px", "s": "s", "m": "m", "mm": "mm", "um": "um", "nm": "nm", "mrad": "mrad",
    "tan": "1", "percent": "%", "counts": "counts",
}  # fmt: skip


def unit_of(name: str) -> str:
    """Return the unit that the last part of a name with one bears, "" where none does; parts are divided by ``/``.

    >>> unit_of("after/median/wavefront_rms_rad"), unit_of("mirror_rx_deg/sigma"), unit_of("frames")
    ('rad', 'deg', '')
    """
    for part in reversed(name.split("/")):
        _, underscore, suffix = part.rpartition("_")
        if underscore and suffix in _SUFFIXES:
            return _SUFFIXES[suffix]
    return ""
