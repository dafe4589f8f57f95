"""``holocal resume RUN``: goes on with an interrupted run."""

from __future__ import annotations

import typer

from holocal.app.cli import options


def resume(
    run: options.RunDirectory,
    runs: options.Runs = options.DEFAULT_RUNS,
    workers: options.Workers = 1,
    scheduler: options.Scheduler = None,
    json: options.Json = False,
    yes: options.Yes = False,
    debug: options.Debug = False,
) -> None:
    """Go on with a run that was interrupted, cut off, or lost its device; or with a tolerance study."""
    from holocal.app import session, tolerancing
    from holocal.app.cli.outcome import report_run, report_study
    from holocal.app.farm import farm_of
    from holocal.app.terminal import Terminal

    directory = options.found_run(run, runs)
    farm = farm_of(workers, scheduler)
    if tolerancing.is_study(directory):
        with Terminal() as terminal:
            terminal.say(f"resuming {directory.name} in {farm}")
            study = tolerancing.resume(directory, farm=farm, said=terminal.counted("bench"))
        raise typer.Exit(report_study(study, as_json=json))
    with Terminal() as terminal:
        terminal.say(f"resuming {directory.name}")
        done = session.resume(directory, observer=terminal)
    raise typer.Exit(report_run(done, as_json=json))
