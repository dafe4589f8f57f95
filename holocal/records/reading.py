"""Files that a user names, read once their size is known to be sensible; what cannot be read is an error that says so.

A file of the wrong kind may be gigabytes: it is refused by its size, before memory is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from holocal.errors import InputError, UsageError


@contextmanager
def reading(path: Path, *, error: type[UsageError] = InputError) -> Iterator[None]:
    """Have a file that the system does not give, or that is no text where text is read, raise `error`."""
    try:
        yield
    except OSError as fault:
        raise error(f"{path} cannot be read: {fault.strerror}.", fix="Check the path.") from fault
    except UnicodeDecodeError as fault:
        raise error(
            f"{path} is not a text file: {fault.reason} at byte {fault.start}.", fix="Save it as UTF-8."
        ) from fault


def checked_bytes(path: Path, *, largest_bytes: int, what: str, fix: str) -> bytes:
    """Return a file's bytes, or raise InputError: it cannot be read, or is larger than `what` ever is."""
    with reading(path):
        _check_size(path, largest_bytes, what, fix, InputError)
        return path.read_bytes()


def checked_text(path: Path, *, largest_bytes: int, what: str, fix: str, error: type[UsageError] = InputError) -> str:
    """Return a UTF-8 file's text, or raise `error` as `checked_bytes` does, or because it is not text."""
    with reading(path, error=error):
        _check_size(path, largest_bytes, what, fix, error)
        return path.read_text(encoding="utf-8")


def _check_size(path: Path, largest_bytes: int, what: str, fix: str, error: type[UsageError]) -> None:
    size = path.stat().st_size
    if size > largest_bytes:
        raise error(
            f"{path} has {size} bytes; {what} has at most {largest_bytes}.", fix=fix, measured=size, limit=largest_bytes
        )
