"""How a run's end is told: verdict, what comes next, or its JSON."""

from __future__ import annotations

from holocal.app.terminal import Terminal, emit, emit_json
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
