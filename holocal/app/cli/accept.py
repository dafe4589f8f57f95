"""``holocal accept RUN``: the only way a result becomes the rig's calibration; ``--rollback`` undoes the last."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def accept(
    run: Annotated[
        Path | None, typer.Argument(metavar="[RUN]", help="A run directory, or the end of its name.")
    ] = None,
    rollback: Annotated[bool, typer.Option("--rollback", help="Restore what was in force before.")] = False,
    rig: Annotated[
        str | None, typer.Option("--rig", metavar="NAME|FILE.toml", help="The rig; default: the run's own.")
    ] = None,
    runs: options.Runs = options.DEFAULT_RUNS,
    set_: options.Set = None,
    json: options.Json = False,
    yes: options.Yes = False,
    debug: options.Debug = False,
) -> None:
    """Put a run's result in force as the rig's calibration, or restore the one before."""
    from holocal.app.configuration import rig_config, stored_rig
    from holocal.app.session import claimed_rig
    from holocal.app.terminal import Terminal, emit_json
    from holocal.loop.lock import locked
    from holocal.loop.record import RunRecord
    from holocal.records import calibration
    from holocal.records.rig import identity

    if rollback == (run is not None):
        raise typer.BadParameter("give a RUN, or --rollback with --rig.", param_hint="RUN")
    if rollback:
        name = rig_config(rig or options.DEFAULT_RIG, set_ or [], device="cpu").name
        with locked(calibration.rig_directory(name) / "lock", f"rig {name}"):
            state = calibration.rollback(name)
    else:
        assert run is not None
        directory = options.found_run(run, runs)
        stored = stored_rig(RunRecord(directory).config())
        config = rig_config(rig, set_ or [], device="cpu") if rig is not None else stored
        name = config.name
        with claimed_rig(config) as device:
            state = calibration.accept(directory, identity(device.facts()))
    accepted = dict(state.get("accepted", {}))
    terminal = Terminal()
    terminal.say(
        f"in force for {name}: " + (", ".join(f"{key} = {value}" for key, value in accepted.items()) or "none")
    )
    if json:
        emit_json({"schema": 1, "rig": name, "state": state.get("state"), "accepted": accepted})
