"""A laser that the operator switches: holocal knows its lines and can neither light nor darken them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from holocal.errors import ConfigError
from holocal.loop.devices import Finding
from holocal.records.rig_model import Table, WavelengthNm
from holocal.records.validate import validated
from rigs.context import DriverContext
from rigs.light_lines import LINE_WIDTH_M, NM


class ManualTable(Table):
    """``[light]`` with ``driver = "manual"``: `wavelength_nm` is the line that is switched on at the bench now."""

    driver: Literal["manual"] = "manual"
    wavelength_nm: WavelengthNm


class LightFile(Table):
    """The part of a rig's file that the driver reads."""

    light: ManualTable


@dataclass
class ManualLight:
    """One line, always as the operator left it."""

    wavelength_m: float

    def select(self, wavelength_m: float) -> None:
        """Check that the wanted line is the one that the operator switched on."""
        if abs(wavelength_m - self.wavelength_m) > LINE_WIDTH_M:
            raise ConfigError(
                f"a frame at {wavelength_m / NM:g} nm is asked for; the laser switched on by hand has "
                f"{self.wavelength_m / NM:g} nm.",
                fix=f"Switch the other line on and say so: --set light.wavelength_nm={wavelength_m / NM:g}",
                measured=wavelength_m / NM,
                limit=self.wavelength_m / NM,
                code="light-line",
            )

    def on(self) -> None:
        """Do nothing: the operator has switched it on."""

    def off(self) -> None:
        """Do nothing: only the operator can. `inspect` says so."""

    def inspect(self) -> tuple[Finding, ...]:
        """Return that dark frames are dark only if something else makes them so."""
        return (
            Finding(
                "light switched by hand",
                "stays on for dark frames and after the run",
                "off by command",
                "",
                None,
                "Close a shutter for dark frames, or use a laser that a driver can switch.",
            ),
        )


def open_light(table: Mapping[str, Any], context: DriverContext) -> ManualLight:
    """Return the light of a table."""
    checked = validated(LightFile, {"light": table}, source=context.source).light
    return ManualLight(checked.wavelength_nm * NM)
