"""``holocal resume RUN``: goes on with an interrupted run."""

from __future__ import annotations

import typer

from holocal.app.cli import options


def resume(
    run: options.RunDirectory,
    runs: options.Runs = options.DEFAULT_RUNS,
    json: options.Json = False,
    yes: options.Yes = False,
    debug: options.Debug = False,
) -> None:
    """Go on with a run that was interrupted, cut off, or lost its device."""
    from holocal.app import session
    from holocal.app.cli.outcome import report_run
    from holocal.app.terminal import Terminal

    directory = options.found_run(run, runs)
    with Terminal() as terminal:
        terminal.say(f"resuming {directory.name}")
        done = session.resume(directory, observer=terminal)
    raise typer.Exit(report_run(done, as_json=json))
