"""``holocal bench``: run time against error of every stage, in units of a bare FFT pair."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options

STAGES = ("synthesis", "density", "frame", "encoders", "quality", "camera", "propagation")


def bench(
    stage: Annotated[
        list[str] | None, typer.Option("--stage", metavar="|".join(STAGES), help="Only this; may be repeated.")
    ] = None,
    size: Annotated[
        list[str] | None, typer.Option("--size", metavar="WxH", help="Panel; default 1920x1080 and 3840x2160.")
    ] = None,
    runs: Annotated[int, typer.Option("--repeats", min=1, max=99, help="Runs per number; the median is taken.")] = 5,
    out: Annotated[Path | None, typer.Option("--out", help="Directory for benchmarks.md, .json and plots.")] = None,
    device: options.Device = "cpu",
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Measure run time against error of every stage: table, JSON, plots."""
    from holocal.app.bench.document import as_markdown, write_page
    from holocal.app.bench.measure import machine
    from holocal.app.bench.run import parsed_size, rows_of
    from holocal.app.terminal import Terminal, emit, emit_json
    from holocal.errors import UsageError
    from holocal.records.files import make_directory, write_json

    stages = tuple(stage or STAGES)
    for name in stages:
        if name not in STAGES:
            raise UsageError(f"--stage {name} is not known.", fix=f"Choose {', '.join(STAGES)}.")
    sizes = [parsed_size(text) for text in size or ("1920x1080", "3840x2160")]
    chosen = options.checked_device(device)
    if out is not None:
        make_directory(out)
    surroundings = machine()
    with Terminal() as terminal:
        rows = list(rows_of(stages, sizes, runs=runs, device=chosen, say=terminal.waiting))
    found = {"schema": 1, "machine": surroundings, "stages": list(stages), "rows": rows}
    if out is not None:
        write_json(out / "benchmarks.json", found)
        write_page(out, rows, surroundings)
    if json:
        emit_json(found)
    else:
        emit(as_markdown(rows, surroundings))
