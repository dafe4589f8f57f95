"""A contact sheet: a picture in each cell, a row per value of what was changed, a column per place."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure as Canvas

from holocal.app.report.drawing import BEFORE, IMAGE_COLOURS
from holocal.loop.procedure import Figure

CELL_INCHES, LARGEST_INCHES = 0.62, 11.0
LEFT, BOTTOM, RIGHT, TOP = 0.8, 1.0, 0.15, 0.35  # margins, inches


def draw_sheet(figure: Figure) -> Canvas:
    """Return the canvas of "sheet" (rows x cell, columns x cell) from 0 to 1, with the values "rows" (rows,) beside it.

    `labels` are the columns'; where "best" (columns,) is given, a mark stands at that value of each column, none at
    NaN. The rows' values change evenly.
    """
    sheet = np.asarray(figure.arrays["sheet"], np.float64)
    rows = np.asarray(figure.arrays["rows"], np.float64).ravel()
    columns = max(1, len(figure.labels))
    cell = min(CELL_INCHES, LARGEST_INCHES / max(columns, len(rows)))
    width, height = LEFT + max(cell * columns, 2.6) + RIGHT, BOTTOM + cell * len(rows) + TOP
    canvas = Canvas(figsize=(width, height))
    axes = canvas.add_axes(
        (LEFT / width, BOTTOM / height, cell * columns / width, cell * len(rows) / height)  # cells are square
    )
    extent = (-0.5, columns - 0.5, len(rows) - 0.5, -0.5)
    axes.imshow(sheet, cmap=IMAGE_COLOURS, vmin=0.0, vmax=1.0, extent=extent, interpolation="nearest", aspect="auto")
    axes.set_yticks(range(len(rows)), [f"{value:+.2f}" for value in rows])
    axes.set_xticks(range(len(figure.labels)), figure.labels, rotation=30, ha="right")
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(rows) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="#3c4a57", linewidth=0.5)
    axes.tick_params(which="minor", length=0)
    axes.set_ylabel(figure.unit)
    axes.set_xlabel("zone at x, y degrees")
    axes.set_title(figure.title, loc="left")
    best = figure.arrays.get("best")
    if best is not None and len(rows) > 1:
        at = (np.asarray(best, np.float64).ravel() - rows[0]) / (rows[1] - rows[0])
        for column in np.flatnonzero(np.isfinite(at)):
            for side in (-1, 1):  # at the cell's edges: the spot itself stays free
                axes.plot([column + 0.28 * side, column + 0.48 * side], [at[column]] * 2, color=BEFORE, linewidth=1.6)
    return canvas
