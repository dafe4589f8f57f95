"""The calibration of a rig: which accepted run of each procedure is in force, and the way back.

One directory per rig under ``HOLOCAL_HOME`` (default: the user's data directory)::

    <home>/rigs/<rig>/entries/<run>/     what `ENTRY_FILES` names, copied from the run, never changed
    <home>/rigs/<rig>/states/0003.json   procedure -> entry, and the state before
    <home>/rigs/<rig>/current.json       which state is in force; swapped by one rename
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from holocal.errors import InputError, RefusedError
from holocal.records.files import make_directory, read_json, read_toml, storage_error, sync, write_json
from holocal.records.manifest import read_manifest, require_intact
from holocal.records.maps import Maps, read_maps
from holocal.records.rig import digest
from holocal.records.run_files import part_entry, parts_of

SCHEMA = 1
ENTRY_FILES = ("identity.json", "config.toml", "result.json", "maps.exr")


@dataclass(frozen=True)
class Accepted:
    """One accepted run: its result, its maps, when it was accepted, and the procedure's parameters."""

    procedure: str
    entry: str
    accepted_utc: str
    result: Mapping[str, Any]
    maps: Maps
    parameters: Mapping[str, Any] = field(default_factory=dict)


def home() -> Path:
    """Return ``HOLOCAL_HOME``, or ``holocal`` in the user's data directory of this platform."""
    if chosen := os.environ.get("HOLOCAL_HOME"):
        return Path(chosen).expanduser()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "holocal"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support" / "holocal"
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "holocal"


def rig_directory(rig: str) -> Path:
    """Return the directory of a rig's calibration and lock; it need not exist."""
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in rig)
    return home() / "rigs" / (safe if safe == rig else f"{safe}-{digest(rig)[:8]}")


def in_force(rig: str) -> dict[str, str]:
    """Return procedure -> entry of what is in force for a rig; empty when nothing is."""
    return dict(_state(rig_directory(rig)).get("accepted", {}))


def load(identity: Mapping[str, Any]) -> dict[str, Accepted]:
    """Return the accepted run per procedure of the rig with this identity.

    Raises
    ------
    RefusedError
        The calibration in force was measured on a rig that differs; names the field and both values.
    """
    directory = rig_directory(str(identity["rig"]))
    state = _state(directory)
    loaded = {}
    for procedure, entry in state.get("accepted", {}).items():
        folder = directory / "entries" / entry
        check_identity(
            read_json(folder / "identity.json"),
            identity,
            subject=f"the accepted {procedure} calibration ({entry})",
            fix=f"Work without it (`--corrections none`), or measure again: `holocal run {procedure} "
            f"--rig {identity['rig']} --corrections none`, then `holocal accept`.",
        )
        loaded[procedure] = Accepted(
            procedure,
            entry,
            str(state.get("accepted_utc", "")),
            read_json(folder / "result.json"),
            read_maps(folder / "maps.exr"),
            dict(read_toml(folder / "config.toml").get("parameters", {})),
        )
    return loaded


def read_run(run: Path) -> dict[str, Accepted]:
    """Return what a finished run found as if it were accepted (``--corrections RUN``), after checking its files."""
    _check_complete(run)
    found = {}
    for part in parts_of(run).values() or (run,):
        result = read_json(part / "result.json")
        procedure = str(result["procedure"])
        found[procedure] = Accepted(procedure, run.name, "", result, read_maps(part / "maps.exr"))
    return found


def check_identity(measured_on: Mapping[str, Any], rig: Mapping[str, Any], *, subject: str, fix: str) -> None:
    """Raise `RefusedError`, naming the first field that differs and both values, unless two identities are the same."""
    if measured_on.get("simulated") and not rig.get("simulated"):
        raise RefusedError(
            f"{subject} was measured on a simulated rig; {rig.get('rig')} is real (simulated: True, False).",
            why="A simulation says nothing about this bench.",
            fix="Run the procedure on this rig.",
            measured=True,
            limit=False,
            code="other-rig",
        )
    for key in sorted({*measured_on, *rig}, key=lambda name: (name != "rig", name)):
        if measured_on.get(key) != rig.get(key):
            raise RefusedError(
                f"{subject} was measured with {key} = {measured_on.get(key)!r}; this rig has {rig.get(key)!r}.",
                why="It would correct another bench.",
                fix=fix,
                measured=measured_on.get(key),
                limit=rig.get(key),
                code="other-rig",
            )


def accept(run: Path, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Put a run's result in force for the rig with this identity, atomically, and return the new state.

    Raises
    ------
    RefusedError
        The run is not complete, missed its targets, corrects nothing, is of another rig, or was measured under other
        corrections than those that are in force now.
    InputError
        The run's files are not what its manifest says.
    """
    _check_complete(run)
    result = read_json(run / "result.json")
    procedure = str(result["procedure"])
    parts = parts_of(run) or {procedure: run}
    for name, part in {procedure: run, **parts}.items():
        _require_correction(run.name, name, read_json(part / "result.json"))
    check_identity(
        read_json(run / "identity.json"),
        identity,
        subject=f"run {run.name}",
        fix=f"Measure this rig: `holocal run {procedure} --rig {identity['rig']}`.",
    )
    directory = rig_directory(str(identity["rig"]))
    state = _state(directory)
    accepted = {
        name: entry
        for name, entry in state.get("accepted", {}).items()
        if read_json(directory / "entries" / entry / "identity.json") == dict(identity)
    }
    _check_corrections(run.name, set(parts), result.get("corrections", {}), accepted)
    entries = {name: part.name if part == run else part_entry(run.name, name) for name, part in parts.items()}
    for name, part in parts.items():
        _copy_entry(part, directory, entries[name])
    return _advance(directory, state, {**accepted, **entries})


def rollback(rig: str) -> dict[str, Any]:
    """Put the state before the last `accept` in force again, and return it; `RefusedError` when there is none."""
    directory = rig_directory(rig)
    state = _state(directory)
    if not state:
        raise RefusedError(f"rig {rig} has no accepted calibration in {directory}.", fix="There is nothing to undo.")
    write_json(directory / "current.json", {"schema": SCHEMA, "state": state["before"]})
    return _state(directory)


def _require_correction(run: str, procedure: str, result: Mapping[str, Any]) -> None:
    """Raise `RefusedError` unless a result met its targets and corrects something."""
    if result.get("targets_met") is not True:
        raise RefusedError(
            f"{run} did not meet its targets: {result.get('sentence', 'see its report')}",
            why="A calibration that missed its target is evidence, not a calibration.",
            fix=f"Run it again: `holocal run {procedure} --rig {result.get('rig')}`.",
            measured=result.get("after"),
            limit=result.get("targets"),
            code="targets-missed",
        )
    if result.get("correction") == "none":
        raise RefusedError(
            f"{run} corrects nothing: {result.get('sentence', 'see its report')}",
            why="It only shows the bench as it is.",
            fix=f"Measure a correction: `holocal run {procedure} --rig {result.get('rig')}`.",
            code="no-correction",
        )


def _check_complete(run: Path) -> None:
    if not run.is_dir():
        raise InputError(f"{run} is not a run directory.", fix="Give the path of a run, or use `--runs DIR`.")
    manifest = read_manifest(run)
    if manifest["status"] != "complete":
        raise RefusedError(
            f"{run.name} is not complete: its status is {manifest['status']!r}.",
            fix=f"Finish it: `holocal resume {run}`.",
            measured=manifest["status"],
            limit="complete",
            code="not-complete",
        )
    require_intact(run)


def _check_corrections(
    run: str, procedures: set[str], measured_under: Mapping[str, str], accepted: Mapping[str, str]
) -> None:
    for name in sorted({*measured_under, *accepted} - procedures):
        if measured_under.get(name) != accepted.get(name):
            raise RefusedError(
                f"{run} was measured under {name} = {measured_under.get(name) or 'none'}; "
                f"in force is {accepted.get(name) or 'none'}.",
                why="Corrections are measured on top of each other.",
                fix=f"Measure again under what is in force: `holocal run {' and '.join(sorted(procedures))}`.",
                measured=measured_under.get(name),
                limit=accepted.get(name),
                code="other-corrections",
            )


def _state(directory: Path) -> dict[str, Any]:
    pointer = directory / "current.json"
    if not pointer.is_file():
        return {}
    name = read_json(pointer).get("state")
    if not name:
        return {}
    state = read_json(directory / "states" / f"{name}.json") if _is_name(name) else {}
    accepted = state.get("accepted")
    if not isinstance(accepted, dict) or not all(map(_is_name, [*accepted, *accepted.values()])):
        raise InputError(
            f"{directory} is damaged: {name!r} is no state of its calibration.",
            fix="Restore the directory from a copy, or move it away and measure again.",
            code="damaged-calibration",
        )
    return state


def _is_name(name: Any) -> bool:
    """Return whether this is the name of something in its own directory."""
    return isinstance(name, str) and name not in ("", ".", "..") and not set(name) & set("/\\\0")


def _copy_entry(run: Path, directory: Path, name: str) -> None:
    entry = make_directory(directory / "entries") / name
    if entry.is_dir():
        return
    partial = entry.with_name(f".{name}.{os.getpid()}.tmp")
    try:
        partial.mkdir()
        for file in ENTRY_FILES:
            shutil.copyfile(run / file, partial / file)
            sync(partial / file)
        partial.rename(entry)
        sync(entry.parent)
    except OSError as error:
        raise storage_error(error, entry) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _advance(directory: Path, before: Mapping[str, Any], accepted: Mapping[str, str]) -> dict[str, Any]:
    states = make_directory(directory / "states")
    number = 1 + max((int(path.stem) for path in states.glob("*.json") if path.stem.isdecimal()), default=0)
    state = {
        "schema": SCHEMA,
        "state": f"{number:04d}",
        "before": before.get("state"),
        "accepted": dict(accepted),
        "accepted_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }
    write_json(states / f"{number:04d}.json", state)
    write_json(directory / "current.json", {"schema": SCHEMA, "state": state["state"]})
    return state
