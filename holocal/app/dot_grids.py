"""A picture's grid of dots as JSON, as a sentence, and drawn over the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from holocal.errors import UsageError
from holocal.estimate.dot_grid import DotGrid, detect_grid
from holocal.records.files import storage_error, write_bytes
from holocal.records.frames import encode_png
from holocal.records.scene import read_scene

SPACING_DRAWN = 24  # pixels: a picture whose dots are closer is enlarged, up to twice
LINE, TENTH, LEFT_OUT, OUTLIER = (0, 200, 0), (255, 120, 0), (0, 0, 255), (0, 200, 255)  # blue, green, red
FIRST = (255, 0, 255)
SHIFT = 4  # binary places of the coordinates that are drawn


def check_overlay(path: Path | None) -> None:
    """Raise an error for a name that no overlay can be written to, before the picture is read."""
    if path is None:
        return
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path} does not end in .png.", fix="Give it a name that ends in .png.")
    if not path.parent.is_dir():
        raise storage_error(FileNotFoundError(2, "no such directory"), path)


def read_grid(path: Path) -> tuple[NDArray[np.float32], DotGrid]:
    """Return a picture (height, width) and its grid.

    Raises
    ------
    InputError
        The picture cannot be read.
    RefusedError
        It shows no grid of dots.
    """
    picture = read_scene(path, allow_black=True)
    return picture, detect_grid(picture)


def as_json(grid: DotGrid) -> dict[str, Any]:
    """Return what the command prints with ``--json``; places in pixels, (0, 0) the centre of the top left one."""
    order = np.lexsort((grid.column, grid.row))
    return {
        "schema": 1,
        "found": grid.found,
        "indexed": len(grid.row),
        "rows": grid.rows,
        "columns": grid.columns,
        "holdout_rms_px": grid.smooth_map.holdout_rms_px,
        "outliers": int(np.count_nonzero(grid.smooth_map.outlier)),
        "points": [
            {
                "row": int(grid.row[i]),
                "column": int(grid.column[i]),
                "x": float(grid.centre_px[i, 0]),
                "y": float(grid.centre_px[i, 1]),
                "sigma_px": float(grid.sigma_px[i]),
            }
            for i in order
        ],
    }


def in_words(grid: DotGrid) -> str:
    """Return the grid as one line."""
    outliers = int(np.count_nonzero(grid.smooth_map.outlier))
    off = f"; {outliers} dots lie off it" if outliers else ""
    return (
        f"{len(grid.row)} of {grid.found} dots indexed in {grid.rows} rows and {grid.columns} columns; "
        f"a smooth map predicts dots it has not seen to {grid.smooth_map.holdout_rms_px:.3f} px (rms){off}."
    )


def write_overlay(path: Path, picture: NDArray[np.float32], grid: DotGrid) -> None:
    """Write the picture as a PNG with the lattice drawn on it.

    Neighbours are joined by lines, every tenth row and column in another colour, from the first dot (a circle); rings
    are dots off the map, crosses are dots that were found but not indexed.
    """
    dark, bright = np.quantile(picture, [0.001, 0.999])
    shown = np.clip((picture - dark) * (255 / max(float(bright - dark), 1e-12)), 0, 255).astype(np.uint8)
    spacing = float(np.sqrt(abs(np.linalg.det(grid.smooth_map.jacobian(np.zeros((1, 2)))[0]))))
    zoom = 2 if spacing < SPACING_DRAWN else 1
    canvas = cv2.cvtColor(
        cv2.resize(shown, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2BGR
    )
    at = np.rint(((grid.centre_px + 0.5) * zoom - 0.5) * 2**SHIFT).astype(int)
    number = np.full((grid.rows, grid.columns), -1)
    number[grid.row, grid.column] = np.arange(len(grid.row))
    for start, end, line in ((number[:, :-1], number[:, 1:], 0), (number[:-1], number[1:], 1)):
        for r, c in zip(*np.nonzero((start >= 0) & (end >= 0)), strict=True):
            colour = TENTH if (r, c)[line] % 10 == 0 else LINE
            cv2.line(canvas, at[start[r, c]], at[end[r, c]], colour, 1, cv2.LINE_AA, SHIFT)
    radius = round(0.42 * spacing * zoom * 2**SHIFT)
    first = int(np.lexsort((grid.column, grid.row))[0])
    cv2.circle(canvas, at[first], radius, FIRST, 2, cv2.LINE_AA, SHIFT)
    for place in at[grid.smooth_map.outlier]:
        cv2.circle(canvas, place, radius, OUTLIER, 1, cv2.LINE_AA, SHIFT)
    for x, y in grid.left_out_px:
        place = (round((x + 0.5) * zoom - 0.5), round((y + 0.5) * zoom - 0.5))
        cv2.drawMarker(canvas, place, LEFT_OUT, cv2.MARKER_TILTED_CROSS, max(4, round(0.4 * spacing * zoom)), 1)
    write_bytes(path, encode_png(canvas))
