"""``holocal run PROCEDURE``: one closed loop: measure, estimate, correct, verify."""

from __future__ import annotations

from typing import Annotated

import typer

from holocal.app.cli import options


def run(
    procedure: Annotated[str, typer.Argument(metavar="PROCEDURE", help="`holocal procedures` lists them.")],
    rig: options.Rig = options.DEFAULT_RIG,
    runs: options.Runs = options.DEFAULT_RUNS,
    seed: options.Seed = 0,
    set_: options.Set = None,
    json: options.Json = False,
    dry_run: options.DryRun = False,
    device: options.Device = "cpu",
    corrections: options.Corrections = "accepted",
    keep_frames: Annotated[
        bool, typer.Option("--keep-frames", help="Keep every frame: the run can be replayed without the bench.")
    ] = False,
    mode: Annotated[
        str | None,
        typer.Option("--mode", metavar="NAME", help="Which of a procedure's ways; as --set mode=NAME."),
    ] = None,
    yes: options.Yes = False,
    debug: options.Debug = False,
) -> None:
    """Measure, estimate, correct and verify in a closed loop."""
    from holocal.app import session
    from holocal.app.cli.outcome import report_run
    from holocal.app.configuration import split_overrides
    from holocal.app.terminal import Terminal, emit_json
    from holocal.records.rig import load_rig

    chosen = [*(set_ or []), *([] if mode is None else [f"{procedure}.mode={mode}"])]
    for_rig, for_procedure = split_overrides(chosen, procedure)
    config = load_rig(rig, for_rig, device=options.checked_device(device))
    with Terminal() as terminal:
        if dry_run:
            planned = session.plan(procedure, config, for_procedure)
            terminal.say(
                f"{procedure} on {config.name}: {planned['frames']} frames in {planned['steps']} steps, about "
                f"{planned['expected_seconds']:.0f} s, exposures up to {1e3 * planned['exposure_ceiling_s']:.4g} ms"
            )
            for sentence in planned["sentences"]:
                terminal.say(f"  {sentence}")
            if json:
                emit_json(planned)
            return
        terminal.say(f"{procedure}  rig {config.name}  seed {seed}")
        done = session.start(
            procedure,
            config,
            for_procedure,
            seed=seed,
            runs=runs,
            corrections_choice=corrections,
            observer=terminal,
            keep_frames=keep_frames,
        )
    raise typer.Exit(report_run(done, as_json=json))
