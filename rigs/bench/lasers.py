"""The bench's lasers: each answers the SCPI of an OBIS laser on a TCP port of its own."""

from __future__ import annotations

import socket
import socketserver
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType

NM = 1e-9
POLL_S = 0.02  # how often a server looks whether it shall end
UNKNOWN, BAD_PARAMETER = "ERR-100", "ERR-220"

Switched = Callable[[float, bool], None]


@dataclass
class Laser:
    """A laser of one wavelength; `power_w` is what its operator has set, by hand.

    `switched` is called with the wavelength in metres and the new state before the command is answered.
    """

    wavelength_nm: float
    power_w: float = 0.02
    serial: str = "L0"
    switched: Switched = lambda wavelength_m, on: None
    on: bool = False
    log: list[str] = field(default_factory=list)

    def answer(self, command: str) -> str:
        """Return the lines with which a command is answered, each ended by CR LF."""
        self.log.append(command)
        head, _, parameter = command.strip().partition(" ")
        name = head.upper()
        values = {
            "*IDN?": f"holocal - bench laser {self.wavelength_nm:g}nm - V1 - {self.serial}",
            "SYSTEM:INFORMATION:WAVELENGTH?": f"{self.wavelength_nm:g}",
            "SYSTEM:INFORMATION:SNUMBER?": self.serial,
            "SOURCE:AM:STATE?": "ON" if self.on else "OFF",
            "SOURCE:POWER:LEVEL?": f"{self.power_w if self.on else 0.0:.6f}",
            "SOURCE:POWER:LEVEL:IMMEDIATE:AMPLITUDE?": f"{self.power_w:.6f}",
            "SYSTEM:ERROR:COUNT?": "0",
        }
        if name in values:
            return f"{values[name]}\r\nOK\r\n"
        if name == "SYSTEM:COMMUNICATE:HANDSHAKING" and parameter.upper() == "ON":
            return "OK\r\n"
        if name != "SOURCE:AM:STATE":
            return f"{UNKNOWN}\r\n"
        if parameter.upper() not in ("ON", "OFF"):
            return f"{BAD_PARAMETER}\r\n"
        self.on = parameter.upper() == "ON"
        self.switched(self.wavelength_nm * NM, self.on)
        return "OK\r\n"


class LaserServer:
    """Lasers on consecutive TCP ports of this host, from construction until `close`; a context manager."""

    def __init__(self, lasers: Sequence[Laser], port: int = 0, host: str = "127.0.0.1") -> None:
        self.lasers = tuple(lasers)
        self._servers = [_Server(laser, (host, port + number if port else 0)) for number, laser in enumerate(lasers)]
        self._threads = [
            threading.Thread(target=server.serve_forever, args=(POLL_S,), daemon=True) for server in self._servers
        ]
        for thread in self._threads:
            thread.start()

    @property
    def urls(self) -> tuple[str, ...]:
        """The address of each laser, as a rig's file takes it."""
        return tuple("socket://{}:{}".format(*server.server_address) for server in self._servers)

    def close(self) -> None:
        """Stop answering; safe to call twice."""
        for server, thread in zip(self._servers, self._threads, strict=True):
            server.shutdown()
            thread.join()
            server.server_close()
            server.hang_up()
        self._servers, self._threads = [], []

    def __enter__(self) -> LaserServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, laser: Laser, address: tuple[str, int]) -> None:
        self.laser = laser
        self.calls: list[socket.socket] = []
        super().__init__(address, _Handler)

    def hang_up(self) -> None:
        """End the connections that are open."""
        for call in self.calls:
            with suppress(OSError):  # it has ended already
                call.shutdown(socket.SHUT_RDWR)


class _Handler(socketserver.StreamRequestHandler):
    server: _Server

    def handle(self) -> None:
        self.server.calls.append(self.request)
        try:
            for line in self.rfile:
                self.wfile.write(self.server.laser.answer(line.decode(errors="replace")).encode())
        except ConnectionError:  # the driver was killed; the laser stays as it was, as a real one does
            return
