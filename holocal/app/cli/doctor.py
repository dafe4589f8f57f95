"""``holocal doctor``: packages, plug-ins, devices, and the pre-flight of a rig, without running anything."""

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
    from holocal.app.health import look
    from holocal.app.terminal import Terminal, emit_json, show_error

    config = rig_config(rig, set_ or [], device=options.checked_device(device))
    with Terminal() as terminal:
        health = look(config, runs, ask_devices=preflight, say=terminal.waiting)
    if json:
        emit_json(health.as_json())
    else:
        _print(health)
    wrong = health.verdict()
    if wrong is None:
        raise typer.Exit(0)
    if debug:
        raise wrong
    show_error(wrong)
    raise typer.Exit(wrong.exit_status)


def _print(health: Any) -> None:
    """Write what was found to stdout: a line per package, plug-in, device and check, and what to do about it."""
    from holocal.app.terminal import emit
    from holocal.loop.preflight.checks import PASS, in_words

    for name, version in health.surroundings["packages"].items():
        emit(f"{name:<32} {version or 'missing'}")
    for item in health.broken:
        emit(f"plug-in {item['name']} ({item['group']}) of {item['package']} is broken: {item['error']}")
    for driver in health.devices:
        for found in driver["found"]:
            emit(f"seen by {driver['driver']}: " + ", ".join(f"{key} {value}" for key, value in found.items() if value))
        if driver["error"] is not None:
            emit(f"{driver['driver']} cannot look for devices: {driver['error']}")
        elif not driver["found"]:
            emit(f"{driver['driver']} sees no device")
    for check in health.checks:
        emit(f"{check.verdict:<8}{check.id:<6}{check.title}: {in_words(check)}")
        if check.verdict != PASS and check.remedy:
            emit(f"{'':<14}{check.remedy}")
