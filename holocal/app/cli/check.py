"""``holocal check``: measures the accepted calibration again in a few frames: holds, or drifted."""

from __future__ import annotations

from typing import Annotated

import typer

from holocal.app.cli import options


def check(
    rig: options.Rig = options.DEFAULT_RIG,
    procedure: Annotated[str | None, typer.Option("--procedure", metavar="NAME", help="Only its calibration.")] = None,
    seed: options.Seed = 0,
    set_: options.Set = None,
    json: options.Json = False,
    device: options.Device = "cpu",
    yes: options.Yes = False,
    debug: options.Debug = False,
) -> None:
    """Measure the accepted calibration again in a few frames: it holds (status 0) or has drifted (3)."""
    from holocal.app import checking
    from holocal.app.configuration import rig_config
    from holocal.app.terminal import Terminal, emit, emit_json

    config = rig_config(rig, set_ or [], device=options.checked_device(device))
    with Terminal() as terminal:
        terminal.say(f"check  rig {config.name}")
        done = checking.check(config, only=procedure, seed=seed, observer=terminal)
    styles = {checking.HOLDS: "green", checking.IS_DRIFTED: "bold yellow"}
    for one in done.checked:
        terminal.say(f"{one.verdict:<8}  {one.procedure}: {one.sentence}", styles.get(one.verdict, ""))
    verdict = checking.HOLDS if done.holds else checking.IS_DRIFTED
    terminal.say(f"{verdict}  in {done.seconds:.1f} s", styles[verdict])
    if not done.holds:
        again = " and ".join(one.procedure for one in done.checked if one.verdict == checking.IS_DRIFTED)
        terminal.say(f"next  measure {again} again, then `holocal accept`")
    if json:
        emit_json(done.as_json())
    else:
        emit(verdict)
    raise typer.Exit(0 if done.holds else 3)
