"""Locks that the operating system drops when a process dies: one per rig, one per run directory."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from holocal.errors import BusyError
from holocal.records.files import make_directory, storage_error


@contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Hold an exclusive lock on `path` (made if need be); `BusyError` at once when another process has it."""
    make_directory(path.parent)
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise storage_error(error, path) from error
    try:
        _take(descriptor, path, what)
        yield
    finally:
        os.close(descriptor)


def _take(descriptor: int, path: Path, what: str) -> None:
    try:
        import fcntl
    except ImportError:  # Windows has no flock; its display and camera drivers are exclusive by themselves
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES):
            raise storage_error(error, path) from error
        holder = os.pread(descriptor, 64, 0).decode(errors="replace").strip() or "unknown"
        raise BusyError(
            f"{what} is in use by another process ({holder}).",
            why="Two programs on one bench disturb each other's measurements.",
            fix=f"Wait for it to end. The lock is {path}.",
            code="busy",
        ) from error
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"process {os.getpid()}\n".encode(), 0)
