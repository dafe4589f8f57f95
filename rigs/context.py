"""What a rig tells each of its drivers when it opens them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DriverContext:
    """A rig's name, the file it comes from (for errors), and its laser lines in metres."""

    rig: str
    source: str
    wavelengths_m: tuple[float, ...]
