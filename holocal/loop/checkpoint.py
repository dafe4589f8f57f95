"""A procedure's frozen state to one file and back: arrays, numbers, strings, tuples, dicts, nested dataclasses."""

from __future__ import annotations

import dataclasses
import io
import json
import sys
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.records.files import read_json, sha256_of, write_bytes, write_json

SCHEMA = 1
POINTER = "checkpoint.json"
TREE = "__tree__"


def state_bytes(state: Any) -> bytes:
    """Return a state as the bytes of an ``.npz``: its arrays, and the tree that holds them as JSON."""
    arrays: dict[str, NDArray[Any]] = {}
    tree = json.dumps(_encoded(state, arrays), allow_nan=True)
    buffer = io.BytesIO()
    np.savez(buffer, **{TREE: np.frombuffer(tree.encode(), np.uint8)}, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def state_from_bytes(data: bytes) -> Any:
    """Return the state of `state_bytes`; its classes must have been imported already."""
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return _decoded(json.loads(arrays.pop(TREE).tobytes()), arrays)


def _encoded(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("a state holds arrays of numbers, not of objects")
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, np.generic):
        return {"scalar": _encoded(np.asarray(value), arrays)["array"]}
    if isinstance(value, Enum):
        return {"enum": _class_name(type(value)), "name": value.name}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {item.name: _encoded(getattr(value, item.name), arrays) for item in dataclasses.fields(value)}
        return {"dataclass": _class_name(type(value)), "fields": fields}
    if isinstance(value, tuple):
        return {"tuple": [_encoded(item, arrays) for item in value]}
    if isinstance(value, list):
        return [_encoded(item, arrays) for item in value]
    if isinstance(value, Mapping):
        return {"dict": [[_encoded(key, arrays), _encoded(item, arrays)] for key, item in value.items()]}
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if hasattr(value, "model_dump"):  # a pydantic model: a procedure's parameters
        return {"model": _class_name(type(value)), "fields": _encoded(value.model_dump(), arrays)}
    raise TypeError(
        f"a state holds a {type(value).__name__}; arrays, numbers, strings, tuples and frozen dataclasses do"
    )


def _decoded(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_decoded(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    match value:
        case {"array": name}:
            return arrays[name]
        case {"scalar": name}:
            return arrays[name][()]
        case {"enum": name, "name": member}:
            return _class(name)[member]
        case {"dataclass": name, "fields": fields}:
            return _class(name)(**{key: _decoded(item, arrays) for key, item in fields.items()})
        case {"model": name, "fields": fields}:
            return _class(name)(**_decoded(fields, arrays))
        case {"tuple": items}:
            return tuple(_decoded(item, arrays) for item in items)
        case {"dict": items}:
            return {_decoded(key, arrays): _decoded(item, arrays) for key, item in items}
        case {"complex": [real, imaginary]}:
            return complex(real, imaginary)
    raise InputError(f"the checkpoint holds something unknown: {list(value)}.", fix="Run the procedure again.")


def _class_name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> Any:
    """Return a class that is imported already: a checkpoint never makes anything be imported."""
    module, _, qualified = name.partition(":")
    found: Any = sys.modules.get(module)
    for part in qualified.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, type):
        raise InputError(f"the checkpoint needs {name}, which this version does not have.", fix="Run it again.")
    return found


@dataclasses.dataclass(frozen=True)
class Progress:
    """What a checkpoint vouches for, beside the state: steps and frames done, seconds used, bytes of the journal."""

    step: int
    frames: int
    seconds: float
    journal_bytes: int


def write_checkpoint(directory: Path, state: Any, progress: Progress) -> None:
    """Write a state into the slot that is not in use, then have ``checkpoint.json`` vouch for it."""
    slot = directory / f"checkpoint-{progress.step % 2}.npz"
    write_bytes(slot, state_bytes(state))
    pointer = {"schema": SCHEMA, "file": slot.name, "sha256": sha256_of(slot), **dataclasses.asdict(progress)}
    write_json(directory / POINTER, pointer)


def read_checkpoint(directory: Path) -> tuple[Any, Progress] | None:
    """Return the last state and its progress, or None when no step was ever finished.

    Raises
    ------
    InputError
        The slot is not what was written: its SHA-256 differs.
    """
    if not (directory / POINTER).is_file():
        return None
    pointer = read_json(directory / POINTER)
    slot = directory / str(pointer.get("file"))
    if pointer.get("schema") != SCHEMA:
        raise InputError(f"{slot} has schema {pointer.get('schema')}; this version reads {SCHEMA}.")
    if not slot.is_file() or sha256_of(slot) != pointer["sha256"]:
        raise InputError(
            f"{slot} is missing or was changed: its SHA-256 is not the one that was written.",
            why="Going on from a damaged state would give a wrong calibration.",
            fix="Run the procedure again.",
            code="damaged-checkpoint",
        )
    progress = Progress(
        int(pointer["step"]), int(pointer["frames"]), float(pointer["seconds"]), int(pointer["journal_bytes"])
    )
    return state_from_bytes(slot.read_bytes()), progress
