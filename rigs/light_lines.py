"""What a laser line is, for every light driver."""

from __future__ import annotations

from collections.abc import Sequence

from holocal.errors import ConfigError

NM = 1e-9
LINE_WIDTH_M = 1e-9  # a line is the one that was asked for when it is within 1 nm of it


def nearest_line(lines_m: Sequence[float], wavelength_m: float) -> int:
    """Return the index of the line nearest to a wavelength; `ConfigError` when none is within 1 nm."""
    index = min(range(len(lines_m)), key=lambda number: abs(lines_m[number] - wavelength_m))
    if abs(lines_m[index] - wavelength_m) > LINE_WIDTH_M:
        listed = ", ".join(f"{line / NM:g}" for line in lines_m)
        raise ConfigError(
            f"The rig has no laser line at {wavelength_m / NM:g} nm.",
            fix=f"Choose one of {listed} nm.",
            measured=wavelength_m / NM,
            limit=listed,
            code="light-line",
        )
    return index
