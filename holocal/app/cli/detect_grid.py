"""``holocal detect-grid IMAGE``: the dots of a regular grid in a photograph, with their rows and columns."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def detect_grid(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="A photograph: PNG, JPEG, TIFF or OpenEXR.")],
    overlay: Annotated[
        Path | None, typer.Option("--overlay", metavar="OUT.png", help="The picture with the grid drawn on it.")
    ] = None,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Find the grid of dots in a picture: each dot's row, column and place."""
    from holocal.app import dot_grids
    from holocal.app.terminal import Terminal, emit, emit_json

    dot_grids.check_overlay(overlay)
    with Terminal() as terminal:
        terminal.waiting(f"the dots of {image.name}")
        picture, grid = dot_grids.read_grid(image)
        if overlay is not None:
            dot_grids.write_overlay(overlay, picture, grid)
    if json:
        emit_json(dot_grids.as_json(grid))
    else:
        emit(dot_grids.in_words(grid))
