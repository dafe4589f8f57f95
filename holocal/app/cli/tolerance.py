"""``holocal tolerance``: what share of built benches will be within spec, and what drives the rest out of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def tolerance(
    tolerances: Annotated[
        Path | None, typer.Argument(metavar="[FILE.toml]", help="Tolerances and spec; left out: the defaults.")
    ] = None,
    rig: options.Rig = options.DEFAULT_RIG,
    benches: Annotated[int, typer.Option("--benches", min=1, help="Benches drawn as the tolerances say.")] = 500,
    scaled: Annotated[
        int, typer.Option("--scaled", min=1, help="Of these so many are traced again at every scale.")
    ] = 100,
    wavelength_nm: options.Wavelength = 515.0,
    workers: options.Workers = 1,
    scheduler: options.Scheduler = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="DIR", help="Go on with a study that was cut off.")
    ] = None,
    runs: options.Runs = options.DEFAULT_RUNS,
    seed: options.Seed = 0,
    set_: options.Set = None,
    json: options.Json = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Draw benches from tolerances and trace the image error of each, before and after correction by hologram."""
    from holocal.app import tolerancing
    from holocal.app.cli.outcome import report_study
    from holocal.app.configuration import split_overrides
    from holocal.app.farm import farm_of
    from holocal.app.terminal import Terminal, emit_json
    from holocal.records.rig import load_rig
    from holocal.records.tolerance_model import Study, read_tolerances
    from holocal.records.validate import validated

    farm = farm_of(workers, scheduler)
    if resume is not None:
        directory = options.found_run(resume, runs)
        with Terminal() as terminal:
            terminal.say(f"resuming {directory.name} in {farm}")
            done = tolerancing.resume(directory, farm=farm, said=terminal.counted("bench"))
        raise typer.Exit(report_study(done, as_json=json))
    for_rig, own = split_overrides(set_ or [], tolerancing.PROCEDURE)
    config = load_rig(rig, for_rig)
    read = read_tolerances(tolerances, own)
    asked = {"benches": benches, "scaled": scaled, "wavelength_nm": wavelength_nm, "tolerances": read}
    study = validated(Study, asked, source="the command line")
    with Terminal() as terminal:
        planned = tolerancing.plan(study, config, farm)
        seconds = planned["expected_seconds"]
        terminal.say(
            f"tolerance on {config.name}: {study.benches} benches, {planned['traces']} traces in {farm}, "
            f"about {seconds:.0f} s, seed {seed}"
        )
        if not dry_run:
            done = tolerancing.start(config, study, seed=seed, runs=runs, farm=farm, said=terminal.counted("bench"))
    if dry_run:
        if json:
            emit_json(planned)
        return
    raise typer.Exit(report_study(done, as_json=json))
