"""``holocal doctor``: packages, plug-ins, and the pre-flight of a rig, without running anything."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from holocal.app.cli import options


def doctor(
    rig: options.Rig = options.DEFAULT_RIG,
    preflight: Annotated[bool, typer.Option("--preflight/--no-preflight", help="Ask the rig's devices.")] = True,
    runs: options.Runs = options.DEFAULT_RUNS,
    set_: options.Set = None,
    json: options.Json = False,
    device: options.Device = "cpu",
    debug: options.Debug = False,
) -> None:
    """Check packages, plug-ins and a rig: what is there, what is broken, what to do."""
    from holocal.app.configuration import rig_config
    from holocal.app.terminal import Terminal, emit, emit_json
    from holocal.errors import RefusedError
    from holocal.loop.environment import environment
    from holocal.records import plugins

    config = rig_config(rig, set_ or [], device=options.checked_device(device))
    surroundings = environment()
    broken = [
        {"name": plugin.name, "package": plugin.package, "error": plugin.error}
        for group in (plugins.RIGS, plugins.PROCEDURES)
        for plugin in plugins.plugins(group)
        if plugin.error is not None
    ]
    missing = [name for name, version in surroundings["packages"].items() if version is None]
    with Terminal() as terminal:
        checks = _preflight(config, runs, terminal) if preflight else []
    failed = [item for item in checks if item["verdict"] == "fail"]
    healthy = not (failed or missing)
    if json and healthy:
        emit_json({"schema": 1, "healthy": True, **surroundings, "broken_plugins": broken, "checks": checks})
    if not json:
        for name, version in surroundings["packages"].items():
            emit(f"{name:<32} {version or 'missing'}")
        for item in broken:
            emit(f"plug-in {item['name']} of {item['package']} is broken: {item['error']}")
        for check in checks:
            emit(f"{check['verdict']:<5} {check['id']:<5} {check['title']}: {check['measured']} {check['unit']}")
    if not healthy:
        names = [f"{item['id']} {item['title']}" for item in failed] + [f"package {name}" for name in missing]
        raise RefusedError(
            f"{len(names)} things are wrong: {'; '.join(names)}.",
            fix=" ".join([item["remedy"] for item in failed] + ["Install holocal again."] * bool(missing)),
            measured=len(names),
            limit=0,
            code="unhealthy",
        )
    raise typer.Exit(0)


def _preflight(config: Any, runs: Any, terminal: Any) -> list[dict[str, Any]]:
    """Return the pre-flight's checks of a rig, with the panel blank and the light off afterwards."""
    import time
    from pathlib import Path

    from holocal.app.session import claimed_rig
    from holocal.loop.preflight import preflight
    from holocal.loop.runner import dark_at_the_end
    from holocal.loop.shooting import Shooter

    where = next((path for path in (runs, *Path(runs).resolve().parents) if path.is_dir()), Path.cwd())
    with claimed_rig(config) as rig, dark_at_the_end(rig):
        terminal.waiting("the pre-flight")
        began = time.monotonic()
        facts = rig.facts()
        checks = preflight(Shooter(rig, facts, lambda *_: None), facts, None, where)
        terminal.preflight(checks, time.monotonic() - began)
    return [check.as_json() for check in checks]
