"""Scenes that a TOML file lists: the file's tables, each checked against its model, and the images that it names."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from holocal.errors import ConfigError, InputError
from holocal.records.reading import checked_text
from holocal.records.validate import validated

Model = TypeVar("Model", bound=BaseModel)

SCHEMA = 1
LARGEST_FILE_BYTES = 4 * 2**20  # a thousand views are 100 KB


def read_tables(path: Path) -> dict[str, Any]:
    """Return a TOML file's tables without its schema, or raise InputError: absent, not TOML, another schema."""
    text = checked_text(
        path,
        largest_bytes=LARGEST_FILE_BYTES,
        what="a list of images",
        fix="Give the TOML file that lists the images.",
    )
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not a TOML file: {error}.", fix="Correct that line.") from error
    schema = tables.pop("schema", SCHEMA)
    if type(schema) is not int or schema != SCHEMA:
        raise InputError(
            f"{path}: schema is {schema!r}; this holocal reads schema {SCHEMA}.",
            fix=f"Write schema = {SCHEMA}, or leave it out.",
            measured=schema,
            limit=SCHEMA,
        )
    return tables


def checked(model: type[Model], tables: Mapping[str, Any], *, source: str) -> Model:
    """Return tables as a model, or raise InputError that names `source` and the key."""
    try:
        return validated(model, tables, source=source)
    except ConfigError as error:
        raise InputError(
            error.what, why=error.why, fix=error.fix, measured=error.measured, limit=error.limit, code=error.code
        ) from error


def named_file(path: Path, name: str, *, source: str, key: str) -> Path:
    """Return the file that a TOML file at `path` names, relative to it, or raise InputError: there is none."""
    found = path.parent / name
    try:
        there = found.is_file()
    except (OSError, ValueError):  # a name that is too long, or has a null character
        there = False
    if not there:
        raise InputError(
            f"{source}: {key} = {name!r} is not a file.",
            fix=f"Paths are relative to the directory of {path.name}.",
            measured=str(found),
        )
    return found


def of_one_size(shape: tuple[int, ...], other: tuple[int, ...], *, source: str, what: str) -> None:
    """Raise InputError unless two images have one shape (rows, columns)."""
    if shape != other:
        raise InputError(
            f"{source}: {what} has {shape[1]} x {shape[0]} pixels; {other[1]} x {other[0]} are needed.",
            fix="Scale one of them.",
            measured=list(shape[::-1]),
            limit=list(other[::-1]),
        )
