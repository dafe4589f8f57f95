"""The manifest of a run directory: written last, with the SHA-256 and the size of every other file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
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
    files = manifest.get("files")
    if not isinstance(files, Mapping) or not all(map(_is_entry, files.values())):
        raise InputError(
            f"{directory / NAME} is damaged: it lists no files.", fix="Restore it from a copy, or measure again."
        )
    return manifest


def _is_entry(said: Any) -> bool:
    return isinstance(said, Mapping) and isinstance(said.get("bytes"), int) and isinstance(said.get("sha256"), str)


def problems(directory: Path) -> list[str]:
    """Return what differs between a run directory and its manifest, a sentence each; empty when all is well."""
    listed = read_manifest(directory)["files"]
    found = [_problem(directory, name, said) for name, said in listed.items()]
    found += [f"{name} is not in the manifest." for name in listed_files(directory) if name not in listed]
    return [sentence for sentence in found if sentence]


def require_intact(directory: Path) -> dict[str, Any]:
    """Return a run's manifest after checking every file; `InputError`, naming what differs, for a damaged run."""
    if not directory.is_dir():
        raise InputError(f"{directory} is not a run directory.", fix="Give the path of a run, or use `--runs DIR`.")
    if found := problems(directory):
        raise InputError(
            f"{directory.name} is not what was measured: {' '.join(found)}",
            why="Its numbers would be taken for measured ones.",
            fix="Restore the files from a copy, or measure again.",
            measured=len(found),
            limit=0,
            code="damaged-run",
        )
    return read_manifest(directory)


def _problem(directory: Path, name: str, said: Mapping[str, Any]) -> str:
    """Return what is wrong with a listed file, "" when nothing is."""
    inside = PurePosixPath(name)
    if inside.is_absolute() or ".." in inside.parts:
        return f"{name} lies outside the run's directory."
    path = directory / name
    try:
        if any(part.is_symlink() for part in (path, *path.parents) if directory in part.parents):
            return f"{name} is a symbolic link: a run has its own files."
        if not path.is_file():
            return f"{name} is missing."
        size = path.stat().st_size
        if size != said["bytes"]:
            return f"{name} has {size} bytes; the manifest says {said['bytes']}."
        same = sha256_of(path) == said["sha256"]
    except (OSError, ValueError) as error:
        return f"{name} cannot be read: {error}."
    return "" if same else f"{name} was changed: its SHA-256 is not the manifest's."
