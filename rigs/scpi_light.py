"""Lasers that speak SCPI, one per line: a light whose lines are switched on and off, and never made brighter."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import Field, model_validator

from holocal.errors import DeviceError
from holocal.loop.devices import Finding
from holocal.records.rig_model import Table
from holocal.records.validate import validated
from rigs.context import DriverContext
from rigs.light_lines import NM, nearest_line
from rigs.scpi_laser import LineTable, ScpiLaser


class ScpiTable(Table):
    """``[light]`` with ``driver = "scpi"``: a ``[[light.lines]]`` for every laser."""

    driver: Literal["scpi"] = "scpi"
    lines: tuple[LineTable, ...] = Field(min_length=1, max_length=16)

    @model_validator(mode="after")
    def _every_laser_has_its_own_port(self) -> ScpiTable:
        urls = [line.url for line in self.lines]
        if len(set(urls)) < len(urls):
            raise ValueError(f"two of light.lines have the same url: {', '.join(urls)}")
        return self


class LightFile(Table):
    """The part of a rig's file that the driver reads; errors then name ``light.<key>``."""

    light: ScpiTable


@dataclass
class ScpiLight:
    """The lasers of a bench; at most one is on."""

    lasers: tuple[ScpiLaser, ...]
    _selected: int = 0
    _lit: bool = False
    _closing: ExitStack = field(default_factory=ExitStack, repr=False)

    def select(self, wavelength_m: float) -> None:
        """Choose the laser nearest to a wavelength; when the light is on, it changes over."""
        index = nearest_line([laser.table.wavelength_nm * NM for laser in self.lasers], wavelength_m)
        if self._lit and index != self._selected:
            self.off()
            self._selected = index
            self.on()
        self._selected = index

    def on(self) -> None:
        """Switch the chosen laser on; returns when its light is there."""
        self._lit = True  # before it is: a failure on the way leaves it to be switched off
        self.lasers[self._selected].emit()

    def off(self) -> None:
        """Switch every laser off, each though another does not answer."""
        failed: list[DeviceError] = []
        for laser in self.lasers:
            try:
                laser.switch(on=False)
            except DeviceError as error:
                failed.append(error)
        if failed:
            raise failed[0]
        self._lit = False

    def identity(self) -> Mapping[str, Any]:
        """Return which lasers they are."""
        return {"serials": [laser.serial for laser in self.lasers]}

    def inspect(self) -> tuple[Finding, ...]:
        """Return the power that the operator has set on every laser, against its limit."""
        findings = []
        for laser in self.lasers:
            limit, found = laser.table.max_power_mw, laser.power_set_mw()
            findings.append(
                Finding(
                    f"laser {laser.table.wavelength_nm:g} nm: power set",
                    "unknown" if found is None else round(found, 4),
                    "none given" if limit is None else limit,
                    "mW",
                    None if limit is None or found is None else found <= limit,
                    "Lower it by hand." if limit is not None else "Set max_power_mw in [[light.lines]].",
                )
            )
        return tuple(findings)

    def close(self) -> None:
        """Let the ports go; safe to call twice."""
        self._closing.close()


def open_light(table: Mapping[str, Any], context: DriverContext) -> ScpiLight:
    """Return the lasers of a table, all off; every wavelength of ``[optics]`` must have one."""
    checked = validated(LightFile, {"light": table}, source=context.source).light
    for wavelength_m in context.wavelengths_m:
        nearest_line([line.wavelength_nm * NM for line in checked.lines], wavelength_m)
    with ExitStack() as stack:
        lasers = []
        for line in checked.lines:
            lasers.append(ScpiLaser.open(line))
            stack.callback(lasers[-1].close)
        light = ScpiLight(tuple(lasers))
        light._closing.callback(stack.pop_all().close)
        return light
    raise AssertionError  # the stack swallows nothing
