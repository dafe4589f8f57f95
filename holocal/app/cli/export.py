"""``holocal export RUN``: a run for other programs, in one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options

SUFFIXES = {".npz": "npz", ".h5": "hdf5", ".hdf5": "hdf5", ".exr": "exr"}


def export(
    run: options.RunDirectory,
    form: Annotated[
        str | None, typer.Option("--format", metavar="npz|hdf5|exr", help="Default: as --out is named, or npz.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Default: the run's name, in this directory.")
    ] = None,
    runs: options.Runs = options.DEFAULT_RUNS,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Write a run's maps, tables and numbers, with names, units and axes, to one file; a damaged run is refused."""
    from holocal.app.export import formats
    from holocal.app.terminal import emit, emit_json

    chosen = form or SUFFIXES.get(out.suffix.lower() if out else ".npz")
    if chosen not in formats.FORMATS:
        what = f"{form!r} is not one of" if form else f"{out} does not name a format; give --format"
        raise typer.BadParameter(f"{what} {', '.join(formats.FORMATS)}.", param_hint="--format")
    suffix = formats.FORMATS[chosen][0]
    if chosen == "exr" and out is not None and out.suffix.lower() != suffix:
        raise typer.BadParameter(f"{out}: an OpenEXR file is named {suffix}.", param_hint="--out")
    directory = options.found_run(run, runs)
    path = out or Path(f"{directory.resolve().name}{suffix}")
    contents = formats.export(directory, chosen, path)
    if json:
        said = {"schema": 1, "run": str(directory), "format": chosen, "file": str(path)}
        emit_json({**said, "quantities": len(contents.quantities), "bytes": path.stat().st_size})
    else:
        emit(str(path))
