"""A rig's file: found by name or path, typed, with the origin of every value; and the rig's fingerprint.

Built-in names come from the entry-point group ``holocal.rig_files``: its name is the rig's, its value the package that
has ``<name>.toml`` among its data, so a lab's package ships its own files the same way::

    [project.entry-points."holocal.rig_files"]
    bench-a = "lab_rigs"            # lab_rigs/bench-a.toml, whose kind names an entry point of holocal.rigs
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from typing import Any

from holocal.errors import ConfigError
from holocal.records.facts import RigFacts
from holocal.records.reading import checked_text
from holocal.records.rig_model import SimulatedRig
from holocal.records.validate import closest, validated

FILES_GROUP = "holocal.rig_files"
LARGEST_FILE_BYTES = 4 * 2**20  # a phase table of 256 levels is 5 KB


@dataclass(frozen=True)
class RigConfig:
    """A rig's file, resolved.

    Attributes
    ----------
    name
        The built-in name, or the file's name without its suffix.
    kind
        Which plug-in of the group ``holocal.rigs`` opens it.
    source
        The file it was read from.
    tables
        The resolved tables as plain data; a rig of another kind checks its own.
    model
        The typed form of a simulated rig; None for other kinds.
    origins
        Dotted key -> ``"default"``, the file's name, or ``"--set"``.
    device
        Where a simulated rig computes: ``"cpu"`` or ``"cuda"``.
    """

    name: str
    kind: str
    source: str
    tables: Mapping[str, Any]
    model: SimulatedRig | None
    origins: Mapping[str, str] = field(default_factory=dict)
    device: str = "cpu"

    @property
    def simulated(self) -> SimulatedRig:
        """The typed form of a simulated rig; `ConfigError` for another kind."""
        if self.model is None:
            raise ConfigError(
                f"{self.source}: kind = {self.kind!r} is not a simulated rig.", fix='Use kind = "simulated".'
            )
        return self.model


def built_in_rigs() -> dict[str, str]:
    """Return the names of the rig files that installed packages ship, each with its package."""
    return {point.name: point.value for point in sorted(entry_points(group=FILES_GROUP), key=lambda p: p.name)}


def load_rig(name_or_path: str, overrides: Sequence[str] | Mapping[str, Any] = (), *, device: str = "cpu") -> RigConfig:
    """Return the rig of a built-in name or a TOML file, with ``key.path=value`` overrides applied.

    Raises
    ------
    ConfigError
        The rig is not known, its file is not TOML, a key is unknown or a value impossible.
    """
    name, source, text = _read(name_or_path)
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source} is not a TOML file: {error}.", fix="Correct that line.") from error
    origins = dict.fromkeys(_leaves(tables), Path(source).name)
    for key, value in parse_overrides(overrides).items():
        _set(tables, key, value, source)
        origins[key] = "--set"
    return resolve(name, source, tables, origins, device=device)


def resolve(
    name: str, source: str, tables: Mapping[str, Any], origins: Mapping[str, str], *, device: str = "cpu"
) -> RigConfig:
    """Return checked tables as a `RigConfig`; values that `origins` does not name are defaults."""
    kind = tables.get("kind")
    if not isinstance(kind, str) or not kind:
        raise ConfigError(
            f"{source}: the key kind is missing or not a name.",
            why="It says which plug-in opens the rig.",
            fix='Add kind = "simulated", or the name that `holocal rigs` lists.',
        )
    model = None
    if kind == "simulated":
        said = {key: f"--set {key}" for key, origin in origins.items() if origin == "--set"}
        model = validated(SimulatedRig, tables, source=source, origins=said)
        tables = model.model_dump(mode="json")
    where = {key: origins.get(key, "default") for key in _leaves(tables)}
    return RigConfig(name, kind, source, tables, model, where, device)


def parse_overrides(overrides: Sequence[str] | Mapping[str, Any]) -> dict[str, Any]:
    """Return ``key.path=value`` texts as a dictionary; a value is read as TOML, and as a string where it is not."""
    if isinstance(overrides, Mapping):
        return dict(overrides)
    parsed = {}
    for text in overrides:
        key, equals, value = text.partition("=")
        key = key.strip()
        if not equals or not key or any(not part for part in key.split(".")):
            raise ConfigError(
                f"--set {text} is not of the form key.path=value.", fix="For example --set slm.pitch_um=3.74."
            )
        try:
            parsed[key] = tomllib.loads(f"value = {value.strip()}")["value"]
        except (tomllib.TOMLDecodeError, KeyError):
            parsed[key] = value.strip()
    return parsed


def _read(name_or_path: str) -> tuple[str, str, str]:
    built_in = built_in_rigs()
    if name_or_path in built_in:
        try:
            resource = files(built_in[name_or_path]) / f"{name_or_path}.toml"
            return name_or_path, str(resource), resource.read_text(encoding="utf-8")
        except (ImportError, OSError) as error:
            raise ConfigError(
                f"rig {name_or_path}: the package {built_in[name_or_path]} does not give its file: {error}.",
                fix="Install that package again.",
            ) from error
    path = Path(name_or_path)
    if path.suffix != ".toml" and not path.is_file():
        raise ConfigError(
            f"rig {name_or_path!r} is neither a known name nor a file.{closest(name_or_path, built_in)}",
            fix=f"Known rigs: {', '.join(built_in) or 'none'}; or give the path of a .toml file.",
            code="unknown-rig",
        )
    text = checked_text(
        path,
        largest_bytes=LARGEST_FILE_BYTES,
        what="a rig's file",
        fix="Give the TOML file that describes the rig.",
        error=ConfigError,
    )
    return path.stem, str(path), text


def _leaves(tables: Mapping[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key, value in tables.items():
        dotted = f"{prefix}{key}"
        found += _leaves(value, f"{dotted}.") if isinstance(value, Mapping) else [dotted]
    return found


def _set(tables: dict[str, Any], key: str, value: Any, source: str) -> None:
    *parents, last = key.split(".")
    table = tables
    for part in parents:
        inner = table.setdefault(part, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"--set {key}: {part} is a value in {source}, not a table.")
        table = inner
    table[last] = value


def fingerprint(config: RigConfig) -> dict[str, Any]:
    """Return what identifies a rig, flat and JSON-ready, without what is unknown of it (misalignment, seed)."""
    flat: dict[str, Any] = {"kind": config.kind}
    tables = config.tables
    for table in ("slm", "optics", "camera"):
        for key, value in sorted(dict(tables.get(table, {})).items()):
            if table == "camera" and key not in CAMERA_IDENTITY:
                continue
            long = isinstance(value, (list, tuple)) and len(value) > 16
            flat[f"{table}.{key}"] = digest(list(value)) if long else value
    return flat


# What says which camera it is; the rest of [camera] is how well it works, which changes with temperature and age.
CAMERA_IDENTITY = ("width", "height", "field_deg", "bits", "vendor", "model", "serial")


def identity(facts: RigFacts) -> dict[str, Any]:
    """Return the flat identity of an opened rig: what its facts say, and its own fingerprint's further keys."""
    slm, camera = facts.slm, facts.camera
    flat: dict[str, Any] = {"rig": facts.name, "simulated": facts.simulated}
    for name, part, keys in (
        ("slm", slm, ("width", "height", "pitch_m", "bits", "vendor", "model", "serial")),
        ("camera", camera, ("width", "height", "full_scale", "bits", "vendor", "model", "serial")),
    ):
        flat |= {f"{name}.{key}": getattr(part, key) for key in keys}
    flat["camera.field_rad"] = list(camera.field_rad)
    flat["optics.wavelengths_m"] = list(facts.wavelengths_m)
    flat["optics.pupil_diameter_m"] = facts.pupil_diameter_m
    flat["optics.eye_relief_m"] = facts.eye_relief_m
    return json.loads(json.dumps({**facts.fingerprint, **flat}, sort_keys=True))  # type: ignore[no-any-return]


def digest(value: Any) -> str:
    """Return the SHA-256 of plain data, the same for the same data whatever the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def with_device(config: RigConfig, device: str) -> RigConfig:
    """Return the same rig computing on another device."""
    return replace(config, device=device)
