"""Gathers what a run left in its directory and fills the template. Every number is the one in ``result.json``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from holocal import __version__
from holocal.app.report.drawing import convergence, draw
from holocal.app.report.numbers import goals, number
from holocal.loop.figures import read_figures
from holocal.loop.record import read_journal
from holocal.records.files import read_json


def page(directory: Path) -> str:
    """Return the report as HTML."""
    config = tomllib.loads((directory / "config.toml").read_text(encoding="utf-8"))
    if config["procedure"] == "tolerance":
        from holocal.app.report.study import study_page

        return study_page(directory, config)
    result = _optional(directory / "result.json")
    error = _optional(directory / "error.json")
    journal = read_journal(directory)
    steps = [line for line in journal if line["event"] == "step"]
    return filled(
        "template.html",
        run=directory.name,
        config=config,
        result=result,
        error=error,
        verdict=_verdict(result, error, steps),
        goals=[] if result is None else goals(result),
        figures=[{"figure": figure, "data": draw(figure)} for figure in read_figures(directory)],
        convergence=convergence(steps),
        steps=steps,
        incidents=[line for line in journal if line["event"] in ("incident", "error")],
        bad_frames=[line["file"] for line in journal if line.get("event") == "incident" and line.get("file")],
        preflight=_optional(directory / "preflight.json"),
        identity=read_json(directory / "identity.json"),
        environment=read_json(directory / "environment.json"),
        shots=_shots(journal),
        command=command(config),
        tables=[] if result is None else result.get("tables", []),
        scalars=_scalars(result),
    )


def filled(name: str, **values: Any) -> str:
    """Return a template of this package with values, in the house's style."""
    here = files(__package__)
    template = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template.filters["number"] = number
    style = here.joinpath("style.css").read_text(encoding="utf-8")
    text = here.joinpath(name).read_text(encoding="utf-8")
    return template.from_string(text).render(style=style, version=__version__, **values)


def command(config: Mapping[str, Any]) -> str:
    """Return the command that would measure the same again."""
    parts = ["holocal run", config["procedure"], "--rig", config["rig"]["name"], f"--seed {config['seed']}"]
    values = {f"rig.tables.{key}": value for key, value in _flat(config["rig"]["tables"]).items()}
    values |= {f"parameters.{key}": value for key, value in _flat(config.get("parameters", {})).items()}
    for key, origin in config.get("origins", {}).items():
        if origin == "--set" and key in values:
            name = key.removeprefix("rig.tables.").removeprefix("parameters.")
            parts.append(f"--set {name}={_literal(values[key])}")
    return " ".join(parts)


def _verdict(result: Mapping[str, Any] | None, error: Mapping[str, Any] | None, steps: list[Any]) -> dict[str, str]:
    if result is not None and error is None:
        met = result["targets_met"]
        return {
            "class": "met" if met else "missed",
            "word": "Met" if met else "Not met",
            "sentence": result["sentence"],
        }
    if error is not None:
        resumable = error.get("exit_status") in (6, 130)
        return {
            "class": "failed",
            "word": "Stopped" if resumable else "Failed",
            "sentence": f"{error['what']} {len(steps)} steps were finished.",
        }
    return {"class": "failed", "word": "Unfinished", "sentence": f"The run was cut off after {len(steps)} steps."}


def _scalars(result: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what a procedure found beside its goals, flat."""
    known = {
        "schema", "procedure", "rig", "run", "targets_met", "outcome", "sentence", "frames", "preflight_frames",
        "steps", "seconds", "seed", "before", "after", "targets", "corrections", "truth",
        "tables",
    }  # fmt: skip
    found = {} if result is None else {key: value for key, value in result.items() if key not in known}
    return {key: value for key, value in _flat(found).items() if not isinstance(value, list) or len(value) <= 8}


def _shots(journal: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        {"step": line.get("step", "verification"), **shot}
        for line in journal
        if line["event"] in ("step", "verified")
        for shot in line.get("shots", [])
    ]


def _flat(tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in tables.items():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def _literal(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f'"{text}"' if " " in text else text


def _optional(path: Path) -> dict[str, Any] | None:
    return read_json(path) if path.is_file() else None
