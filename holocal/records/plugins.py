"""What installed packages offer as rigs, procedures and drivers. A broken one is listed with its error."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from holocal.errors import ConfigError
from holocal.records.validate import closest

RIGS = "holocal.rigs"
PROCEDURES = "holocal.procedures"
SLMS = "holocal.slms"
CAMERAS = "holocal.cameras"
LIGHTS = "holocal.lights"
# Functions () -> sequence of mappings or dataclasses: the devices that are there, none of them opened.
DISCOVER = "holocal.discover"
KINDS = {
    RIGS: "rig kind",
    PROCEDURES: "procedure",
    SLMS: "SLM driver",
    CAMERAS: "camera driver",
    LIGHTS: "light driver",
    DISCOVER: "search for devices",
}


@dataclass(frozen=True)
class Plugin:
    """An entry point: `target` is what it names, or None and `error` says why."""

    name: str
    value: str
    package: str
    version: str
    target: Any
    error: str | None


def plugins(group: str) -> list[Plugin]:
    """Return every plug-in of a group, loaded where it can be, by name."""
    return [_loaded(point) for point in sorted(entry_points(group=group), key=lambda point: point.name)]


def load(group: str, name: str) -> Any:
    """Return what the plug-in `name` gives; `ConfigError` when it is unknown or broken."""
    known = {point.name: point for point in entry_points(group=group)}
    what = KINDS[group]
    if name not in known:
        raise ConfigError(
            f"the {what} {name!r} is not known.{closest(name, known)}",
            fix=f"Known: {', '.join(sorted(known)) or 'none'}.",
            measured=name,
            limit=sorted(known),
            code=f"unknown-{what.replace(' ', '-')}",
        )
    plugin = _loaded(known[name])
    if plugin.error is not None:
        raise ConfigError(
            f"the {what} {name!r} of package {plugin.package} cannot be loaded: {plugin.error}",
            fix=f"Install {plugin.package} again, or mend {plugin.value}.",
            code="broken-plug-in",
        )
    return plugin.target


def procedure(name: str) -> Any:
    """Return the procedure of a name, ready to be asked."""
    found = load(PROCEDURES, name)
    return found() if isinstance(found, type) else found


def _loaded(point: EntryPoint) -> Plugin:
    package = point.dist.name if point.dist is not None else "?"
    version = point.dist.version if point.dist is not None else "?"
    try:
        return Plugin(point.name, point.value, package, version, point.load(), None)
    except Exception as error:  # noqa: BLE001 - another's code may fail in any way while it is imported
        return Plugin(point.name, point.value, package, version, None, f"{type(error).__name__}: {error}")
