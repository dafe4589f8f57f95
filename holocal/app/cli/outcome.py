"""How a run's end is told: verdict, what comes next, or its JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from holocal.app.report.numbers import number
from holocal.app.terminal import Terminal, emit, emit_json

if TYPE_CHECKING:
    from holocal.app.tolerancing import Done
    from holocal.loop.runner import RunResult


def report_run(done: RunResult, *, as_json: bool) -> int:
    """Write a finished run's verdict and next commands, with its JSON on stdout if asked; return the exit status."""
    met = done.exit_status == 0
    terminal = Terminal()
    terminal.say(f"{'done' if met else 'target not met'}  {done.sentence}", "bold green" if met else "bold yellow")
    frames, seconds = done.result["frames"], done.result["seconds"]
    terminal.say(f"      {frames} frames, {seconds:.1f} s   report  {done.directory / 'report.html'}")
    if met and done.result.get("correction") != "none":
        terminal.say(f"next  holocal accept {done.directory}")
    if as_json:
        emit_json(done.result)
    else:
        emit(str(done.directory))
    return done.exit_status


def report_study(done: Done, *, as_json: bool) -> int:
    """Write a tolerance study's table and verdict, with its JSON on stdout if asked; return the exit status."""
    met = done.exit_status == 0
    terminal = Terminal()
    for line in study_table(done.result):
        terminal.say(line)
    terminal.say(
        f"{'done' if met else 'target not met'}  {done.result['sentence']}", f"bold {'green' if met else 'yellow'}"
    )
    terminal.say(f"      {done.result['seconds']:.1f} s   report  {done.directory / 'report.html'}")
    if as_json:
        emit_json(done.result)
    else:
        emit(str(done.directory))
    return done.exit_status


def study_table(result: Mapping[str, Any]) -> list[str]:
    """Return the lines of a study's table: the worse benches' numbers of every stage, the yields, the drivers."""
    stages = ("before", "after", "pose")
    lines = [f" {'of the worse benches (5 %)':<28}{'as built':>10}{'corrected':>11}{'own pose':>10}{'limit':>9}"]
    for name in [*result["before"]["spread"], "yield"]:
        values = [number(result[stage][name]) for stage in stages]
        limit = number(result["targets"][name]) if name in result["targets"] else ""
        lines.append(f" {name:<28}{values[0]:>10}{values[1]:>11}{values[2]:>10}{limit:>9}")
    lines.append(
        f" {'degree of freedom':<22}{'tolerance':>10}{'px per unit':>12}{'rad per unit':>13}{'allowed':>9}  fails by"
    )
    for name, freedom in result["freedoms"].items():
        slope, may = freedom["per_unit"], freedom["allowed"]["after"]
        allowed = (
            ""
            if may is None
            else number(may["tolerance"])
            if may["tolerance"] is not None
            else f">{number(may['tried_to'])}"
        )
        lines.append(
            f" {name:<22}{number(freedom['tolerance']):>10}{number(slope['distortion_rms_px']):>12}"
            f"{number(slope['wavefront_median_rad']):>13}{allowed:>9}  {may['why'] if may else ''}"
        )
    return lines
