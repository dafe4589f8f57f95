"""The manifest of a run directory: written last, with the SHA-256 and the size of every other file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from holocal.errors import InputError
from holocal.records.files import read_json, sha256_of, write_json

NAME = "manifest.json"
SCHEMA = 1


def listed_files(directory: Path) -> list[str]:
    """Return the relative names of the files that a manifest vouches for: all but itself, locks and temporaries."""
    names = (path.relative_to(directory).as_posix() for path in sorted(directory.rglob("*")) if path.is_file())
    return [name for name in names if name != NAME and not any(part.startswith(".") for part in name.split("/"))]


def write_manifest(directory: Path, status: str, **further: Any) -> None:
    """Write ``manifest.json``: `status` is "complete", "interrupted" or "failed"; `further` keys go in beside it."""
    files = {
        name: {"sha256": sha256_of(directory / name), "bytes": (directory / name).stat().st_size}
        for name in listed_files(directory)
    }
    write_json(directory / NAME, {"schema": SCHEMA, "status": status, **further, "files": files})


def read_manifest(directory: Path) -> dict[str, Any]:
    """Return a run's manifest; `InputError` when there is none or it is of a newer schema."""
    if not (directory / NAME).is_file():
        raise InputError(
            f"{directory} has no {NAME}.",
            why="The run was cut off, or this is no run directory.",
            fix="`holocal resume` goes on with a run that was cut off.",
        )
    manifest = read_json(directory / NAME)
    if manifest.get("schema") != SCHEMA:
        raise InputError(
            f"{directory / NAME} has schema {manifest.get('schema')}; this version reads {SCHEMA}.",
            fix="Use the version of holocal that wrote it.",
            measured=manifest.get("schema"),
            limit=SCHEMA,
        )
    return manifest


def problems(directory: Path) -> list[str]:
    """Return what differs between a run directory and its manifest, a sentence each; empty when all is well."""
    listed = read_manifest(directory)["files"]
    found = []
    for name, said in listed.items():
        path = directory / name
        if not path.is_file():
            found.append(f"{name} is missing.")
        elif path.stat().st_size != said["bytes"]:
            found.append(f"{name} has {path.stat().st_size} bytes; the manifest says {said['bytes']}.")
        elif sha256_of(path) != said["sha256"]:
            found.append(f"{name} was changed: its SHA-256 is not the manifest's.")
    found += [f"{name} is not in the manifest." for name in listed_files(directory) if name not in listed]
    return found
