"""A laser that speaks the SCPI of Coherent's OBIS family, over a serial port or a socket.

The driver switches emission on and off and reads; it never sends a power level. Commands used, each ended by CR LF and
answered by ``OK`` or ``ERR<number>`` (hand-shaking), a query by its value first:

==========================================  ===================================================
``SYSTem:COMMunicate:HANDshaking ON``       answer every command
``*IDN?``                                   maker, model, firmware
``SYSTem:INFormation:WAVelength?``          nm: is it the laser that the file says?
``SYSTem:INFormation:SNUMber?``             serial number
``SOURce:AM:STATe ON|OFF``, ``...STATe?``   emission
``SOURce:POWer:LEVel?``                     power that comes out now, W
``SOURce:POWer:LEVel:IMMediate:AMPLitude?``  power that the operator has set, W
==========================================  ===================================================
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

from pydantic import Field

from holocal.errors import BusyError, ConfigError, DeviceError, RefusedError, SafetyStop
from holocal.records.rig_model import Table, WavelengthNm

ANSWER_S = 2.0  # an OBIS answers within 0.1 s
WAVELENGTH_TOLERANCE_NM = 10.0  # a diode laser sold as 515 nm may emit at 510 or 520
EMISSION_S = 10.0  # the CDRH delay before emission is 5 s
EMISSION_SHARE = 0.5  # of the set power: below it the laser is still coming up
POLL_S = 0.05


class LineTable(Table):
    """``[[light.lines]]``: one laser. `url` is a port ("/dev/ttyUSB0", "COM3") or "socket://host:port".

    Above `max_power_mw`, as it is set or as it comes out, the light is refused or switched off again. `settle_s` is
    waited after the power is there.
    """

    wavelength_nm: WavelengthNm
    url: str = Field(min_length=1)
    baudrate: int = Field(default=115200, ge=300, le=4_000_000)
    max_power_mw: float | None = Field(default=None, gt=0.0, le=1e6)
    settle_s: float = Field(default=0.2, ge=0.0, le=600.0)


class NotUnderstoodError(DeviceError):
    """The laser answered a command with an error."""


@dataclass
class ScpiLaser:
    """One laser at the other end of a port."""

    table: LineTable
    name: str
    serial: str
    _port: Any = field(repr=False)

    @classmethod
    def open(cls, table: LineTable) -> ScpiLaser:
        """Return the laser of a line, asked for its name, with emission off."""
        laser = cls(table, f"the laser at {table.url}", "", _port(table))
        with ExitStack() as stack:
            stack.callback(laser.close)
            laser.tell("SYSTem:COMMunicate:HANDshaking ON")
            laser.switch(on=False)
            laser.name = f"{laser.ask('*IDN?')} at {table.url}"
            laser.serial = laser._ask_if_known("SYSTem:INFormation:SNUMber?") or ""
            laser._require_wavelength()
            laser.require_power_set()
            stack.pop_all()
        return laser

    def ask(self, query: str) -> str:
        """Return the answer to a query."""
        self._send(query)
        answer = self._line(query)
        if answer.startswith("ERR"):
            raise self._refused(query, answer)
        closing = self._line(query)
        if closing != "OK":
            raise self._refused(query, closing)
        return answer

    def tell(self, command: str) -> None:
        """Send a command and wait until the laser has taken it."""
        self._send(command)
        answer = self._line(command)
        if answer != "OK":
            raise self._refused(command, answer)

    def switch(self, *, on: bool) -> None:
        """Switch emission, and ask whether it is so."""
        wanted = "ON" if on else "OFF"
        self.tell(f"SOURce:AM:STATe {wanted}")
        found = self.ask("SOURce:AM:STATe?").upper()
        if found != wanted:
            raise DeviceError(
                f"{self.name} was switched {wanted} and says {found}.",
                fix="Check its key switch, its interlock and its fault lamp." if on else "Switch it off by hand.",
                measured=found,
                limit=wanted,
                code="light-state",
            )

    def power_mw(self) -> float:
        """Return the power that comes out now."""
        return self._number("SOURce:POWer:LEVel?", self.ask("SOURce:POWer:LEVel?")) * 1e3

    def power_set_mw(self) -> float | None:
        """Return the power that the operator has set, None where the laser does not say."""
        query = "SOURce:POWer:LEVel:IMMediate:AMPLitude?"
        answer = self._ask_if_known(query)
        return None if answer is None else self._number(query, answer) * 1e3

    def require_power_set(self) -> None:
        """Raise, before the light goes on, when the power that was set is above the line's limit."""
        limit, found = self.table.max_power_mw, self.power_set_mw()
        if limit is None or (found is not None and found <= limit):
            return
        said = "does not say what power it is set to" if found is None else f"is set to {found:.4g} mW"
        raise RefusedError(
            f"{self.name} {said}; light.lines.max_power_mw allows {limit:g} mW.",
            why="Software never lowers or raises a laser's power here.",
            fix="Lower it by hand.",
            measured=found,
            limit=limit,
            code="light-power",
        )

    def emit(self) -> None:
        """Switch on and return when the light is there; off again when it is more than the line's limit."""
        self.require_power_set()
        self.switch(on=True)
        deadline = time.monotonic() + EMISSION_S
        set_mw = self.power_set_mw() or 0.0
        while (power_mw := self.power_mw()) < EMISSION_SHARE * set_mw:
            if time.monotonic() > deadline:
                self.switch(on=False)
                raise DeviceError(
                    f"{self.name} gives {power_mw:.4g} mW after {EMISSION_S:g} s; it is set to {set_mw:.4g} mW.",
                    fix="Check its key switch, its interlock, and that no external modulation holds it down.",
                    measured=power_mw,
                    limit=EMISSION_SHARE * set_mw,
                    code="light-weak",
                )
            time.sleep(POLL_S)
        limit = self.table.max_power_mw
        if limit is not None and power_mw > limit:
            self.switch(on=False)
            raise SafetyStop(
                f"{self.name} gave {power_mw:.4g} mW; light.lines.max_power_mw allows {limit:g} mW. It is off again.",
                fix="Lower its power by hand.",
                measured=power_mw,
                limit=limit,
                code="light-power",
            )
        time.sleep(self.table.settle_s)

    def close(self) -> None:
        """Let the port go."""
        socket = getattr(self._port, "_socket", None)
        self._port.close()
        if socket is not None:
            socket.close()  # pyserial 3.5 leaves it open when the other end is gone

    def _require_wavelength(self) -> None:
        answer = self._ask_if_known("SYSTem:INFormation:WAVelength?")
        if answer is None:
            return
        found = self._number("SYSTem:INFormation:WAVelength?", answer)
        if abs(found - self.table.wavelength_nm) > WAVELENGTH_TOLERANCE_NM:
            raise RefusedError(
                f"{self.name} emits at {found:g} nm; light.lines says {self.table.wavelength_nm:g} nm for that port.",
                why="Two lasers seem to be swapped.",
                fix="Correct the url of the lines.",
                measured=found,
                limit=self.table.wavelength_nm,
                code="other-device",
            )

    def _ask_if_known(self, query: str) -> str | None:
        """Return the answer to a query that not every model knows."""
        try:
            return self.ask(query)
        except NotUnderstoodError:
            return None

    def _number(self, query: str, answer: str) -> float:
        try:
            return float(answer.rstrip("nmW "))
        except ValueError as error:
            raise DeviceError(
                f"{self.name} answered {answer!r} to {query}: that is no number.", code="light-answer"
            ) from error

    def _send(self, text: str) -> None:
        with _losing(self.name, text):
            self._port.reset_input_buffer()  # an answer that came too late belongs to nobody
            self._port.write(f"{text}\r\n".encode("ascii"))

    def _line(self, question: str) -> str:
        with _losing(self.name, question):
            raw: bytes = self._port.readline()
        if not raw.endswith(b"\n"):
            raise DeviceError(
                f"{self.name} did not answer {question} within {ANSWER_S:g} s.",
                why="Nobody knows whether the light is on.",
                fix="Check that it is on and its cable; switch it off by hand; then `holocal resume`.",
                measured=raw.decode(errors="replace"),
                limit=ANSWER_S,
                code="light-lost",
            )
        return raw.decode(errors="replace").strip()

    def _refused(self, question: str, answer: str) -> DeviceError:
        return NotUnderstoodError(
            f"{self.name} answered {answer!r} to {question}.",
            fix="Check its fault lamp, and that it is a laser of this kind.",
            measured=answer,
            limit="OK",
            code="light-answer",
        )


@contextmanager
def _losing(name: str, question: str) -> Iterator[None]:
    """Turn the port's complaints into a `DeviceError`."""
    try:
        yield
    except OSError as error:  # pyserial's own errors are OSErrors
        raise DeviceError(
            f"{name} was lost at {question}: {error}.",
            why="Nobody knows whether the light is on.",
            fix="Check its cable and power; switch it off by hand; then `holocal resume`.",
            code="light-lost",
        ) from error


def _port(table: LineTable) -> Any:
    """Return the open port of a line; `BusyError` when another program has it."""
    try:
        serial = importlib.import_module("serial")
    except ImportError as error:
        raise ConfigError(
            f'the driver "scpi" needs the package pyserial: {error}.',
            fix='pip install "holocal[scpi]"',
            code="missing-extra",
        ) from error
    try:
        return serial.serial_for_url(
            table.url, baudrate=table.baudrate, timeout=ANSWER_S, write_timeout=ANSWER_S, exclusive=True
        )
    except ValueError as error:  # an unknown protocol, a baud rate that the port does not have
        raise ConfigError(f"light.lines.url = {table.url!r} cannot be opened: {error}.", code="light-port") from error
    except OSError as error:
        if "exclusively lock" in str(error) or "Access is denied" in str(error):
            raise BusyError(
                f"the laser's port {table.url} is in use by another program.", fix="Close it.", code="light-busy"
            ) from error
        raise DeviceError(
            f"the laser's port {table.url} cannot be opened: {error}.",
            fix="Check its cable and power, and light.lines.url.",
            code="light-lost",
        ) from error
