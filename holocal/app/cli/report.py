"""``holocal report RUN``: draws a run's report again from its files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def report(
    run: options.RunDirectory,
    out: Annotated[Path | None, typer.Option("--out", help="Where to write it; default: printed path only.")] = None,
    runs: options.Runs = options.DEFAULT_RUNS,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Print where a run's report is; with --out, or when it has none, draw it from the run's files."""
    from holocal.app.report import render_report
    from holocal.app.terminal import emit, emit_json
    from holocal.errors import InputError
    from holocal.records.files import write_bytes

    directory = options.found_run(run, runs)
    if not (directory / "config.toml").is_file():
        raise InputError(f"{directory} is not a run directory: it has no config.toml.", fix="Give the path of a run.")
    path = directory / "report.html" if out is None else out
    if out is not None:
        write_bytes(out, render_report(directory))
    elif not path.is_file():  # a run that was killed: its manifest does not vouch for a report
        path = directory.with_name(f"{directory.name}-report.html")
        write_bytes(path, render_report(directory))
    if json:
        emit_json({"schema": 1, "run": str(directory), "report": str(path)})
    else:
        emit(str(path))
