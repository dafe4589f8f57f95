"""Pydantic's complaints as the errors of this house: file, key, value, limit, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from holocal.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

# pydantic's name of a bound -> how it reads
_BOUNDS = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}


def validated(
    model: type[Model], tables: Mapping[str, Any], *, source: str, origins: Mapping[str, str] | None = None
) -> Model:
    """Return `tables` as a `model`, or raise `ConfigError` that names where the value came from and its key.

    Parameters
    ----------
    source
        What is said to hold the keys: a file, or the name of a procedure.
    origins
        Dotted key -> where its value came from, when that is not `source` (``--set``).
    """
    try:
        return model.model_validate(tuples(tables))
    except ValidationError as error:
        raise _config_error(error, model, source, origins or {}) from error


def tuples(value: Any) -> Any:
    """Return `value` with every list as a tuple, since TOML has lists and frozen data has none."""
    if isinstance(value, Mapping):
        return {key: tuples(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return tuple(tuples(item) for item in value)
    return value


def closest(name: str, known: Iterable[str]) -> str:
    """Return ``" Did you mean x?"`` for the known name nearest to `name`, or an empty string."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return f" Did you mean {found[0]}?" if found else ""


def _config_error(
    error: ValidationError, model: type[BaseModel], source: str, origins: Mapping[str, str]
) -> ConfigError:
    details = error.errors(include_url=False)
    first = details[0]
    path = _path(model, first["loc"])
    key = ".".join(path)
    where = origins.get(key) or next((text for item, text in origins.items() if item.startswith(f"{key}.")), source)
    more = f" ({len(details) - 1} more below it.)" if len(details) > 1 and first["type"] != "literal_error" else ""
    context = first.get("ctx", {})
    if first["type"] == "extra_forbidden":
        known = known_keys(model, path[:-1])
        return ConfigError(
            f"{where}: unknown key {key}.{closest(path[-1], known)}{more}",
            why="A key that is not read would change nothing and nobody would notice.",
            fix=f"Keys known {'in [' + '.'.join(path[:-1]) + ']' if path[:-1] else 'there'}: {', '.join(known)}.",
            measured=key,
            limit=list(known),
            code="unknown-key",
        )
    limit = next(((word, context[name]) for name, word in _BOUNDS.items() if name in context), None)
    value = first["input"]
    if first["type"] == "missing":
        listed = len(first["loc"]) > len(path)
        what = f"{where}: {key} {'has too few values' if listed else 'is missing'}."
        fix = f"Give {key} all its values." if listed else f"Add {key}."
    elif limit is not None:
        what = f"{where}: {key} = {short(value)} is not {limit[0]} {limit[1]}.{more}"
        fix = f"Set {key} to a value {limit[0]} {limit[1]}."
    else:
        message = first["msg"].removeprefix("Value error, ").replace("tuple", "list").replace("dictionary", "table")
        what = f"{where}: {key + ' = ' + short(value) if key else 'the file'} cannot be: {message}.{more}"
        fix = f"Correct {key}." if key else "Correct the file."
    return ConfigError(
        what,
        fix=fix,
        measured=value if isinstance(value, (int, float, str, bool)) else short(value),
        limit=limit[1] if limit else context.get("expected"),
        code="bad-value",
    )


def short(value: Any, length: int = 60) -> str:
    """Return `value` as text of at most `length` characters."""
    text = repr(value) if not isinstance(value, Mapping) else "a table"
    return text if len(text) <= length else text[: length - 3] + "..."


def _path(model: type[BaseModel], location: Sequence[Any]) -> tuple[str, ...]:
    """Return the keys of a pydantic location: its field names, without the members of unions."""
    path: list[str] = []
    current: type[BaseModel] | None = model
    for part in location:
        if current is None:
            break
        path.append(str(part))
        field = current.model_fields.get(str(part))
        inner = field.annotation if field is not None else None
        current = inner if isinstance(inner, type) and issubclass(inner, BaseModel) else None
    return tuple(path)


def known_keys(model: type[BaseModel], path: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the keys that a model, or the table of it at `path`, takes."""
    current: type[BaseModel] = model
    for part in path:
        inner = current.model_fields[part].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return ()
        current = inner
    return tuple(current.model_fields)
