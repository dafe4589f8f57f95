"""``holocal history``: the runs of a rig in time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def history(
    rig: options.Rig = options.DEFAULT_RIG,
    procedure: Annotated[str | None, typer.Option("--procedure", metavar="NAME", help="Only its runs.")] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw the numbers over time, with their targets.")
    ] = None,
    runs: options.Runs = options.DEFAULT_RUNS,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """List a rig's runs in time: verdict, numbers before and after, and which are in force (*) or were (+)."""
    from holocal.app.history import history_of, rig_name, table
    from holocal.app.terminal import Terminal, emit, emit_json

    found = history_of(rig_name(rig), runs, procedure)
    if not found.lines:
        asked = f"{found.rig} and {procedure}" if procedure else found.rig
        Terminal().say(f"no runs of {asked} are known; rigs with runs: {', '.join(found.rigs) or 'none'}")
    if plot is not None:
        from holocal.app.history_plot import write_plot

        write_plot(found, plot)
    if json:
        emit_json({**found.as_json(), **({"plot": str(plot)} if plot else {})})
        return
    for line in table(found):
        emit(line)
    if plot is not None:
        emit(str(plot))
