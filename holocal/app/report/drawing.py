"""Figures as PNG data URIs: one style, the same colours for before and after everywhere, unknown areas hatched."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from holocal.loop.procedure import Figure

INK, MUTED, GRID = "#1c2733", "#5b6b7b", "#dfe5ea"
BEFORE, AFTER, TARGET = "#b4552d", "#1f6f8b", "#2e7d4f"
CURVES = (AFTER, BEFORE, "#7a5195", "#8a8d2c", "#44546a")
MAP_COLOURS, IMAGE_COLOURS = "cividis", "gray"
DPI = 130
STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.titlesize": 10,
}
LARGEST_DRAWN = 900  # pixels of a map along its longer side: the page stays small


def draw(figure: Figure) -> str:
    """Return a figure as a PNG data URI."""
    from matplotlib import rc_context

    with rc_context(STYLE):
        match figure.kind:
            case "pair":
                canvas = _pair(figure)
            case "curve":
                canvas = _curve(figure)
            case "histogram":
                canvas = _histogram(figure)
            case "corner":
                from holocal.app.report.corner import draw_corner  # it takes its colours from here

                canvas = draw_corner(figure)
            case "sheet":
                from holocal.app.report.sheet import draw_sheet

                canvas = draw_sheet(figure)
            case "vectors":
                from holocal.app.report.vectors import draw_vectors

                canvas = draw_vectors(figure)
            case _:
                canvas = _map(figure)
        return data_uri(canvas)


def data_uri(canvas: Canvas) -> str:
    """Return a canvas as a PNG data URI; the same bytes for the same figure."""
    FigureCanvasAgg(canvas)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def convergence(steps: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the goal's number of every step with its sigma and the target line; None when there is nothing to draw."""
    from matplotlib import rc_context

    points = [
        (step["step"], step["progress"])
        for step in steps
        if _is_number(step["progress"].get("value")) and _is_number(step["progress"].get("target"))
    ]
    if not points or len({said.get("quantity") for _, said in points}) > 1:  # a run of several procedures
        return None
    numbers = [number for number, _ in points]
    values = [said["value"] for _, said in points]
    sigmas = [said.get("sigma") or 0.0 for _, said in points]
    with rc_context(STYLE):
        canvas, axes = _canvas(6.4, 2.7)
        axes.errorbar(numbers, values, yerr=sigmas, fmt="o-", color=AFTER, capsize=3, markersize=5, linewidth=1.6)
        target = points[-1][1].get("target")
        if _is_number(target):
            axes.axhline(target, color=TARGET, linestyle="--", linewidth=1.3)
            axes.annotate(
                f"target {target:.3g}",
                (0.01, target),  # on the left: the last step should end near the line
                xycoords=("axes fraction", "data"),
                ha="left",
                va="bottom",
                color=TARGET,
            )
        if min(values) > 0 and max(values) > 10 * min(values):
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=min(0.0, *values))
        axes.set_xticks(numbers)
        axes.set_xlabel("step")
        axes.set_ylabel(str(points[-1][1].get("quantity", "value")))
        return data_uri(canvas)


def _canvas(width: float, height: float, columns: int = 1) -> tuple[Canvas, Any]:
    canvas = Canvas(figsize=(width, height), layout="constrained")
    axes = canvas.subplots(1, columns)
    for one in np.atleast_1d(np.asarray(axes, dtype=object)):
        one.spines[["top", "right"]].set_visible(False)
        one.grid(color=GRID, linewidth=0.6)
        one.set_axisbelow(True)
    return canvas, axes


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _thinned(array: NDArray[Any]) -> NDArray[np.float64]:
    values = np.asarray(array, np.float64)
    step = max(1, max(values.shape) // LARGEST_DRAWN)
    return values[::step, ::step]


def _masked(figure: Figure, name: str) -> NDArray[np.float64]:
    values = _thinned(figure.arrays[name]).copy()
    valid = figure.arrays.get("valid")
    if valid is not None and np.shape(valid) == np.shape(figure.arrays[name]):
        values[_thinned(valid) < 0.5] = np.nan
    return values


def _limits(*pictures: NDArray[np.float64]) -> tuple[float, float]:
    known = np.concatenate([picture[np.isfinite(picture)].ravel() for picture in pictures])
    if known.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(known, [0.5, 99.5]))
    if low >= 0.0 and low < 0.7 * high:
        low = 0.0
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _picture(
    axes: Axes, picture: NDArray[np.float64], figure: Figure, limits: tuple[float, float], title: str
) -> ScalarMappable:
    axes.grid(visible=False)
    axes.set_facecolor("#eceff1")
    extent = figure.extent_deg or (0.0, float(picture.shape[1]), float(picture.shape[0]), 0.0)
    if not np.isfinite(picture).all():
        axes.fill_between(
            extent[:2], extent[2], extent[3], facecolor="#eceff1", edgecolor="#b0bac3", hatch="////", lw=0
        )
    colours = IMAGE_COLOURS if figure.kind == "image" else MAP_COLOURS
    shown = axes.imshow(
        np.ma.masked_invalid(picture),
        cmap=colours,
        vmin=limits[0],
        vmax=limits[1],
        extent=extent,
        interpolation="nearest",
        zorder=2,
    )
    axes.set_title(title, loc="left")
    unit = "degrees" if figure.extent_deg else "pixels"
    axes.set_xlabel(f"x, {unit}")
    axes.set_ylabel(f"y, {unit}")
    return shown


def _map(figure: Figure) -> Canvas:
    names = [name for name, array in figure.arrays.items() if name != "valid" and np.ndim(array) == 2]
    canvas, axes = _canvas(4.3 * max(1, len(names)), 3.6, max(1, len(names)))
    for one, name in zip(np.atleast_1d(np.asarray(axes, dtype=object)), names, strict=False):
        picture = _masked(figure, name)
        title = figure.title if len(names) == 1 else name.replace("_", " ")
        shown = _picture(one, picture, figure, _limits(picture), title)
        canvas.colorbar(shown, ax=one, label=figure.unit, shrink=0.9)
    return canvas


def _pair(figure: Figure) -> Canvas:
    names = [name for name, array in figure.arrays.items() if name != "valid" and np.ndim(array) == 2]
    pictures = [_masked(figure, name) for name in names]
    canvas, axes = _canvas(3.8 * len(names) + 0.6, 3.5, len(names))
    limits = _limits(*pictures)
    every = np.atleast_1d(np.asarray(axes, dtype=object))
    for one, picture, name in zip(every, pictures, names, strict=True):
        shown = _picture(one, picture, figure, limits, name.replace("_", " "))
    canvas.colorbar(shown, ax=list(every), label=figure.unit, shrink=0.9)
    return canvas


def _curve(figure: Figure) -> Canvas:
    canvas, axes = _canvas(6.4, 2.7)
    arrays = {name: np.asarray(array, np.float64).ravel() for name, array in figure.arrays.items()}
    x = arrays.pop("x", None)
    curves = {name: y for name, y in arrays.items() if not name.endswith("sigma") and name != "valid"}
    for (name, y), colour in zip(curves.items(), CURVES * (1 + len(curves) // len(CURVES)), strict=False):
        colour = {"before": BEFORE, "after": AFTER}.get(name, colour)
        at = x if x is not None and x.size == y.size else np.arange(y.size, dtype=np.float64)
        axes.plot(at, y, color=colour, linewidth=1.5, label=name.replace("_", " "), marker="o" if y.size < 30 else "")
        sigma = arrays.get(f"{name}_sigma", arrays.get("sigma") if len(curves) == 1 else None)
        if sigma is not None and sigma.size == y.size:
            axes.fill_between(at, y - sigma, y + sigma, color=colour, alpha=0.2, linewidth=0)
    if figure.target is not None:
        axes.axhline(figure.target, color=TARGET, linestyle="--", linewidth=1.3, label=f"target {figure.target:.3g}")
    if len(curves) > 1 or figure.target is not None:
        axes.legend(frameon=False)
    axes.set_ylabel(figure.unit)
    axes.set_title(figure.title, loc="left")
    return canvas


def _histogram(figure: Figure) -> Canvas:
    canvas, axes = _canvas(6.4, 2.7)
    known = {name: np.asarray(array, np.float64).ravel() for name, array in figure.arrays.items()}
    known = {name: values[np.isfinite(values)] for name, values in known.items()}
    low, high = _limits(*known.values())
    for (name, values), colour in zip(known.items(), CURVES, strict=False):
        colour = {"before": BEFORE, "after": AFTER}.get(name, colour)
        axes.hist(values, bins=np.linspace(low, high, 61), color=colour, alpha=0.6, label=name.replace("_", " "))
    if figure.target is not None:
        axes.axvline(figure.target, color=TARGET, linestyle="--", linewidth=1.3)
    if len(known) > 1:
        axes.legend(frameon=False)
    axes.set_xlabel(figure.unit)
    axes.set_ylabel("count")
    axes.set_title(figure.title, loc="left")
    return canvas
