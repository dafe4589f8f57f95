"""A user's file opened: absent, unreadable, too large or not text, said the same way by every reader of scenes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from holocal.errors import InputError


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what goes wrong while a file is read into an `InputError` that names it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.", fix="Check the path.") from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is not a text file: {error.reason} at byte {error.start}.", fix="Save it as UTF-8."
        ) from error


def bytes_of(path: Path, *, at_most: int, fix: str) -> bytes:
    """Return a file's bytes, or raise `InputError` with `fix` when there are more than `at_most`."""
    with reading(path):
        size = path.stat().st_size
        if size > at_most:
            raise InputError(
                f"{path} has {size} bytes; at most {at_most} are read.", fix=fix, measured=size, limit=at_most
            )
        return path.read_bytes()


def text_of(path: Path, *, at_most: int, fix: str) -> str:
    """Return a UTF-8 file's text, or raise `InputError` as `bytes_of` does."""
    data = bytes_of(path, at_most=at_most, fix=fix)
    with reading(path):
        return data.decode("utf-8")
