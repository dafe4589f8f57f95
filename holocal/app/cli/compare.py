"""``holocal compare A B``: two runs of one procedure side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def compare(
    one: Annotated[Path, typer.Argument(metavar="A", help="A run directory, or the end of its name.")],
    other: Annotated[Path, typer.Argument(metavar="B", help="Another run of the same procedure.")],
    runs: options.Runs = options.DEFAULT_RUNS,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Compare two runs: numbers with their errors and whether they differ, and every field that is not the same."""
    from holocal.app import comparing
    from holocal.app.terminal import emit, emit_json

    found = comparing.compare(options.found_run(one, runs), options.found_run(other, runs))
    if json:
        emit_json(found.as_json())
        return
    for line in comparing.lines(found):
        emit(line)
