"""Files that are whole or absent: atomic writes, JSON, and TOML with comments.

Every write goes to a temporary name in the same directory, is flushed to the disk, and is renamed; a reader sees the
old file or the new one. A disk that is full or a directory that cannot be written is a `StorageError`.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from holocal.errors import InputError, StorageError

# Errors of the medium, not of the program: what to say and what to do for each.
_STORAGE_ERRORS = {
    errno.ENOSPC: ("the disk is full", "Free some space or choose another directory."),
    errno.EDQUOT: ("the disk quota is used up", "Free some space or choose another directory."),
    errno.EACCES: ("permission denied", "Choose a directory that you may write to."),
    errno.EPERM: ("operation not permitted", "Choose a directory that you may write to."),
    errno.EROFS: ("the file system is read-only", "Choose a directory that can be written."),
    errno.ENOTDIR: ("a part of the path is not a directory", "Choose another path."),
    errno.EISDIR: ("it is a directory", "Choose another path."),
    errno.ENOENT: ("its directory does not exist", "Make the directory first, or choose another path."),
    errno.ENAMETOOLONG: ("the name is too long", "Choose a shorter path."),
    errno.EIO: ("input/output error", "Check the disk."),
    errno.EFBIG: ("the file is too large for the file system", "Choose another disk."),
}


def storage_error(error: OSError, path: Path) -> StorageError:
    """Return the `StorageError` that says in a sentence what an `OSError` on `path` means."""
    reason, fix = _STORAGE_ERRORS.get(error.errno or 0, (error.strerror or str(error), "Check the disk."))
    return StorageError(
        f"{path} cannot be written: {reason}.",
        why="Nothing was left half written.",
        fix=fix,
        code="storage-full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "storage",
    )


def make_directory(path: Path) -> Path:
    """Return `path` after making it and its parents."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(error, path) from error
    return path


def sync(path: Path) -> None:
    """Have a file or a directory reach the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on a clean exit it becomes `path`, on any error it is removed.

    The temporary name keeps the suffix, since image writers choose the format by it.
    """
    if not path.parent.is_dir():
        raise storage_error(FileNotFoundError(errno.ENOENT, "no such directory"), path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        sync(temporary)
        temporary.replace(path)
        sync(path.parent)
    except OSError as error:
        raise storage_error(error, path) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def json_ready(value: Any) -> Any:
    """Return `value` with numpy scalars and arrays as plain numbers and lists, and non-finite numbers as None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)


def dump_json(value: Any, *, indent: int | None = 1) -> str:
    """Return `value` as JSON text; never NaN, which JSON does not have."""
    return json.dumps(json_ready(value), indent=indent, allow_nan=False, ensure_ascii=False)


def write_json(path: Path, value: Any) -> None:
    """Write `value` as a JSON file, whole or not at all."""
    write_bytes(path, (dump_json(value) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; `InputError` when it is absent, not JSON or not an object."""
    try:
        value = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.", fix="Check the path.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    except (ValueError, RecursionError) as error:  # JSON and Unicode errors both; brackets without end
        raise InputError(f"{path} is not a JSON file: {error}.") from error
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}; an object was expected.")
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file; `InputError` when it is absent or not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.", fix="Check the path.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    except (ValueError, RecursionError) as error:  # TOML and Unicode errors both
        raise InputError(f"{path} is not a TOML file: {error}.") from error


def one_line(text: str) -> str:
    """Return a library's message on one line, without its full stop."""
    return " ".join(text.split()).rstrip(".") or "no reason given"


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def dump_toml(tables: Mapping[str, Any], *, comments: Mapping[str, str] | None = None, head: str = "") -> str:
    """Return nested tables as TOML text; `comments` (dotted key -> text) are set behind their values.

    Values are strings, bools, numbers, and lists or tuples of these and of tables; None is left out, since TOML has no
    null.
    """
    lines = [f"# {line}" for line in head.splitlines()]
    _toml_table(tables, (), comments or {}, lines)
    return "\n".join(lines).strip() + "\n"


def _toml_table(table: Mapping[str, Any], path: tuple[str, ...], comments: Mapping[str, str], lines: list[str]) -> None:
    for key, value in table.items():
        if isinstance(value, Mapping) or value is None:
            continue
        comment = comments.get(".".join((*path, key)))
        lines.append(f"{_toml_key(key)} = {_toml_value(value)}" + (f"  # {comment}" if comment else ""))
    for key, value in table.items():
        if isinstance(value, Mapping):
            inner = (*path, key)
            lines.extend(["", "[" + ".".join(_toml_key(part) for part in inner) + "]"])
            _toml_table(value, inner, comments, lines)


def _toml_key(key: str) -> str:
    bare = key.replace("_", "").replace("-", "")
    return key if bare.isascii() and bare.isalnum() else _toml_value(key)


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else ("nan" if math.isnan(value) else f"{value:+}")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    if isinstance(value, Mapping):  # in a list: an array of tables
        pairs = (f"{_toml_key(key)} = {_toml_value(item)}" for key, item in value.items() if item is not None)
        return "{" + ", ".join(pairs) + "}"
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
