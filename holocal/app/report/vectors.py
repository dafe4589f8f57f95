"""Displacements as arrows, drawn larger than they are at a stated scale."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure as Canvas

from holocal.app.report.drawing import AFTER, BEFORE, MUTED, _canvas
from holocal.loop.procedure import Figure

LONGEST = 0.05  # of the picture's width, the longest arrow
NICE = (1.0, 2.0, 5.0)


def draw_vectors(figure: Figure) -> Canvas:
    """Return a figure of kind "vectors": a panel for each of its arrays (n, 4), x, y, dx, dy.

    x and y are in degrees, dx and dy in `unit`, arrows as many times as long as the panel says.
    """
    names = [name for name, array in figure.arrays.items() if np.ndim(array) == 2]
    canvas, axes = _canvas(4.3 * max(1, len(names)), 4.5, max(1, len(names)))
    for one, name in zip(np.atleast_1d(np.asarray(axes, dtype=object)), names, strict=False):
        _panel(one, name, np.asarray(figure.arrays[name], np.float64), figure)
    return canvas


def _panel(axes: Any, name: str, arrows: np.ndarray[Any, Any], figure: Figure) -> None:
    left, right, bottom, top = figure.extent_deg or (-1.0, 1.0, -1.0, 1.0)
    width = right - left
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_xlabel("x, degrees")
    axes.set_ylabel("y, degrees")
    if not len(arrows):
        axes.set_title(f"{name.replace('_', ' ')}: nothing found", loc="left")
        return
    length = np.linalg.norm(arrows[:, 2:], axis=1)
    longest = max(float(np.quantile(length, 0.98)), 1e-9)
    bar = nice(longest)
    unit_deg = LONGEST * width / longest
    colour = BEFORE if name.startswith("before") else AFTER
    axes.quiver(
        *arrows[:, :2].T, *(arrows[:, 2:] * unit_deg).T,
        angles="xy", scale_units="xy", scale=1.0, color=colour, width=0.003,
    )  # fmt: skip
    axes.set_title(f"{name.replace('_', ' ')}, rms {np.sqrt(np.mean(length**2)):.3g} {figure.unit}", loc="left")
    x, y = left + 0.04 * width, bottom + 0.03 * (top - bottom)
    axes.plot([x, x + bar * unit_deg], [y, y], color=MUTED, linewidth=2.5, solid_capstyle="butt")
    axes.annotate(f"{bar:g} {figure.unit}", (x, y), xytext=(0, 4), textcoords="offset points", color=MUTED)


def nice(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a value > 0."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in NICE if step * power <= value * (1 + 1e-9)))
