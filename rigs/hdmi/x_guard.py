"""What a lost X server becomes: an error that Python can raise.

Xlib ends the process when its connection breaks, and the light would stay on. Both of its handlers must be replaced:
the first one's default calls exit() itself (measured: a process with only the second one replaced still ends), and
after the first has returned the second one decides whether Xlib ends the process or returns from the call.
"""

from __future__ import annotations

import ctypes
import ctypes.util
from dataclasses import dataclass, field
from typing import Any

from holocal.errors import ConfigError

LIBRARY = "libX11.so.6"

_IO_HANDLER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_EXIT_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
_ERROR_HANDLER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)


class _ErrorEvent(ctypes.Structure):
    """Xlib's XErrorEvent."""

    _fields_ = (
        ("type", ctypes.c_int),
        ("display", ctypes.c_void_p),
        ("resource", ctypes.c_ulong),
        ("serial", ctypes.c_ulong),
        ("code", ctypes.c_ubyte),
        ("request", ctypes.c_ubyte),
        ("minor", ctypes.c_ubyte),
    )


@dataclass
class Connection:
    """What became of a connection to an X server; once `lost`, nothing may be asked of it."""

    lost: bool = False
    refused: list[tuple[int, int]] = field(default_factory=list)  # (error code, request) that the server would not do


_guarded: dict[int, Connection] = {}
_kept: list[Any] = []  # Xlib keeps only the addresses of these


def guard(display: int) -> Connection:
    """Return what tells of the connection at an Xlib ``Display *``; from now on its loss does not end the process.

    Raises
    ------
    ConfigError
        The X library is older than 1.7 (November 2020) and cannot survive the loss of its server.
    """
    if display in _guarded:
        return _guarded[display]
    library = ctypes.CDLL(LIBRARY)
    if not hasattr(library, "XSetIOErrorExitHandler"):
        raise ConfigError(
            "the X library of this computer is older than 1.7.",
            why="It ends the program when the X server ends, and the light would stay on.",
            fix="Use a system with libX11 1.7 or later (Debian 12, Ubuntu 22.04, RHEL 9).",
            code="old-libx11",
        )
    _guarded[display] = connection = Connection()
    if not _kept:
        _replace_common_handlers(library)
    handler = _EXIT_HANDLER(lambda _display, _data: setattr(connection, "lost", True))
    _kept.append(handler)
    library.XSetIOErrorExitHandler.argtypes = [ctypes.c_void_p, _EXIT_HANDLER, ctypes.c_void_p]
    library.XSetIOErrorExitHandler(display, handler, None)
    return connection


def lost() -> bool:
    """Return whether a connection of this process was lost."""
    return any(connection.lost for connection in _guarded.values())


def forget(display: int) -> None:
    """Forget a connection that was closed in order: another may come to lie at its address."""
    _guarded.pop(display, None)


def _replace_common_handlers(library: ctypes.CDLL) -> None:
    """Replace the handlers that all connections of the process share.

    A connection that is not guarded still ends the process when it breaks: its own exit handler is Xlib's.
    """
    broken = _IO_HANDLER(lambda _display: 0)
    refused = _ERROR_HANDLER(_note_refusal)
    _kept.extend([broken, refused])
    library.XSetIOErrorHandler.argtypes = [_IO_HANDLER]
    library.XSetIOErrorHandler.restype = ctypes.c_void_p
    library.XSetIOErrorHandler(broken)
    library.XSetErrorHandler.argtypes = [_ERROR_HANDLER]
    library.XSetErrorHandler.restype = ctypes.c_void_p
    library.XSetErrorHandler(refused)


def _note_refusal(display: int, event: int) -> int:
    """Note a request that the server refused: Xlib's own handler would end the process."""
    said = _ErrorEvent.from_address(event)
    if display in _guarded:
        _guarded[display].refused.append((int(said.code), int(said.request)))
    return 0
