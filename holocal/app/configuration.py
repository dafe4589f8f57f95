"""``--set`` shared out between rig and procedure, and a run's ``config.toml`` with the origin of every value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from holocal.records.files import dump_toml
from holocal.records.rig import RigConfig, load_rig, parse_overrides, resolve
from holocal.records.validate import validated

SCHEMA = 1
RIG_KEYS = (
    "kind", "seed", "simulated", "slm", "optics", "misalignment", "camera", "illumination", "light", "safety", "faults",
)  # fmt: skip


@dataclass(frozen=True)
class RunConfig:
    """Everything that was decided before a run: its rig, its parameters, its seed, the corrections in force."""

    procedure: str
    rig: RigConfig
    parameters: BaseModel
    origins: Mapping[str, str]
    seed: int
    corrections: Mapping[str, str]
    keep_frames: bool = False

    def toml(self) -> str:
        """Return the run's ``config.toml``."""
        origins = {f"rig.tables.{key}": value for key, value in self.rig.origins.items()}
        origins |= {f"parameters.{key}": value for key, value in self.origins.items()}
        tables = {
            "schema": SCHEMA,
            "procedure": self.procedure,
            "seed": self.seed,
            "device": self.rig.device,
            "keep_frames": self.keep_frames,
            "rig": {"name": self.rig.name, "source": self.rig.source, "tables": dict(self.rig.tables)},
            "parameters": self.parameters.model_dump(mode="json"),
            "corrections": dict(self.corrections),
            "origins": origins,
        }
        return dump_toml(tables, comments=origins, head="The run's resolved configuration; where each value is from.")


def split_overrides(overrides: Sequence[str], procedure: str | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the overrides that are the rig's and those that are the procedure's.

    A key whose first part is a table of the rig's file is the rig's; ``<procedure>.key`` or another key is the
    procedure's. Without a procedure every key is the rig's.
    """
    rig, own = {}, {}
    for key, value in parse_overrides(overrides).items():
        first, _, rest = key.partition(".")
        if procedure is None or first in RIG_KEYS:
            rig[key] = value
        elif first == "rig" and rest:
            rig[rest] = value
        else:
            own[rest if first == procedure and rest else key] = value
    return rig, own


def rig_config(name: str, overrides: Sequence[str], *, device: str) -> RigConfig:
    """Return a rig for a command that runs no procedure: every ``--set`` is the rig's."""
    return load_rig(name, split_overrides(overrides, None)[0], device=device)


def parameters(
    model: type[BaseModel], overrides: Mapping[str, Any], *, procedure: str, device: str
) -> tuple[BaseModel, dict[str, str]]:
    """Return a procedure's checked parameters and the origin of each.

    A procedure with a parameter `device` is told of ``--device`` unless it was set by name.
    """
    values: dict[str, Any] = {}
    for key, value in overrides.items():
        *parents, last = key.split(".")
        table = values
        for part in parents:
            table = table.setdefault(part, {})
        table[last] = value
    if "device" in model.model_fields:
        values.setdefault("device", device)
    said = {key: f"--set {key}" for key in overrides}
    checked = validated(model, values, source=f"procedure {procedure}", origins=said)
    return checked, {key: "--set" if key in values else "default" for key in model.model_fields}


def stored_rig(config: Mapping[str, Any]) -> RigConfig:
    """Return the rig as a run's ``config.toml`` has it."""
    rig, prefix = config["rig"], "rig.tables."
    origins = {
        key.removeprefix(prefix): value for key, value in config.get("origins", {}).items() if key.startswith(prefix)
    }
    return resolve(rig["name"], rig["source"], rig["tables"], origins, device=config.get("device", "cpu"))


def without_faults(rig: RigConfig) -> tuple[RigConfig, dict[str, object]]:
    """Return a simulated rig without its faults, and those that were active: a resumed run's drill is over."""
    ended = {} if rig.model is None else rig.model.faults.active()
    if not ended:
        return rig, {}
    tables = {key: value for key, value in rig.tables.items() if key != "faults"}
    origins = {key: value for key, value in rig.origins.items() if not key.startswith("faults.")}
    return resolve(rig.name, rig.source, tables, origins, device=rig.device), ended


def stored_parameters(model: type[BaseModel], config: Mapping[str, Any]) -> BaseModel:
    """Return a procedure's parameters as a run's ``config.toml`` has them."""
    return validated(model, config.get("parameters", {}), source="the run's config.toml")
