"""What `holocal doctor` finds: packages, plug-ins, devices that are there, and a rig's pre-flight."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

from holocal.app.session import claimed_rig, expectations, lock_of
from holocal.errors import BusyError, HolocalError, RefusedError
from holocal.loop.environment import environment
from holocal.loop.preflight import Check, preflight
from holocal.loop.preflight.checks import FAIL, failed
from holocal.loop.shooting import Shooter
from holocal.records import calibration, plugins
from holocal.records.rig import RigConfig

GROUPS = (plugins.RIGS, plugins.PROCEDURES, plugins.SLMS, plugins.CAMERAS, plugins.LIGHTS, plugins.DISCOVER)


@dataclass
class Health:
    """What was found; `error` is what kept the pre-flight from its end."""

    surroundings: dict[str, Any]
    broken: list[dict[str, str]]
    devices: list[dict[str, Any]] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    error: HolocalError | None = None

    @property
    def missing(self) -> list[str]:
        """The packages that are not installed."""
        return [name for name, version in self.surroundings["packages"].items() if version is None]

    def verdict(self) -> HolocalError | None:
        """Return what is wrong as one error, None when nothing is; a broken plug-in stops nothing."""
        if self.error is not None:
            return self.error
        wrong = failed(self.checks)
        names = [f"{item.id} {item.title}" for item in wrong] + [f"package {name}" for name in self.missing]
        if not names:
            return None
        return RefusedError(
            f"{len(names)} things are wrong: {'; '.join(names)}.",
            fix=" ".join([item.remedy for item in wrong] + ["Install holocal again."] * bool(self.missing)),
            measured=len(names),
            limit=0,
            code="unhealthy",
        )

    def as_json(self) -> dict[str, Any]:
        """Return everything, JSON-ready."""
        wrong = self.verdict()
        return {
            "schema": 1,
            "healthy": wrong is None,
            **self.surroundings,
            "broken_plugins": self.broken,
            "devices": self.devices,
            "checks": [item.as_json() for item in self.checks],
            **({} if wrong is None else {"error": wrong.as_json()}),
        }


def look(config: RigConfig, runs: Path, *, ask_devices: bool, say: Callable[[str], None]) -> Health:
    """Return the health of this installation and, unless told not to ask its devices, of a rig."""
    health = Health(environment(), broken_plugins())
    if not ask_devices:
        return health
    say("the devices that are there")
    health.devices = devices_seen()
    say("the pre-flight")
    try:
        health.checks = rig_checks(config, runs)
    except BusyError as error:
        lock = lock_of(config.name)
        owner = lock.read_text(encoding="utf-8").strip() if lock.is_file() else ""
        health.checks = [Check("P01", "lock of the rig", owner or "another process", "this one", "", FAIL, error.fix)]
        health.error = error
    except HolocalError as error:  # a device that is lost or light that is too bright: what else was found is told too
        health.error = error
    return health


def rig_checks(config: RigConfig, runs: Path) -> list[Check]:
    """Return the pre-flight's checks of a rig; its panel is blank and its light off afterwards."""
    where = next((path for path in (runs, *runs.resolve().parents) if path.is_dir()), Path.cwd())
    expected = expectations(config, calibration.in_force(config.name), identities=True)
    with claimed_rig(config) as rig:
        facts = rig.facts()
        return preflight(Shooter(rig, facts, lambda *_: None), facts, None, where, expected)


def broken_plugins() -> list[dict[str, str]]:
    """Return the plug-ins of every group that cannot be loaded."""
    return [
        {"group": group, "name": plugin.name, "package": plugin.package, "error": plugin.error}
        for group in GROUPS
        for plugin in plugins.plugins(group)
        if plugin.error is not None
    ]


def devices_seen() -> list[dict[str, Any]]:
    """Return, for each plug-in of the group ``holocal.discover``, what it found, without opening it, or why it cannot.

    A plug-in is a function without arguments that returns a sequence of mappings or dataclasses.
    """
    seen = []
    for plugin in plugins.plugins(plugins.DISCOVER):
        if plugin.error is not None:
            continue  # told among the broken ones
        began = time.monotonic()
        try:
            found, error = [_plain(item) for item in plugin.target()], None
        except Exception as failure:  # noqa: BLE001 - another's code, and a driver's: told, and it stops nothing
            found, error = [], str(failure) or type(failure).__name__
        seconds = round(time.monotonic() - began, 3)
        seen.append({"driver": plugin.name, "found": found, "error": error, "seconds": seconds})
    return seen


def _plain(item: Any) -> dict[str, str]:
    """Return a device as name -> text; a dataclass's fields that are not for printing (handles) are left out."""
    if is_dataclass(item) and not isinstance(item, type):
        values: Mapping[str, Any] = {one.name: getattr(item, one.name) for one in fields(item) if one.repr}
    else:
        values = dict(item)
    return {str(name): str(value) for name, value in values.items()}
