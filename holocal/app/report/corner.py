"""Samples of a posterior: each parameter's histogram, each pair's contours, the Laplace fit and the truth over them."""

from __future__ import annotations

from typing import Any

import corner
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from holocal.app.report.drawing import AFTER, CURVES, INK, MUTED
from holocal.loop.procedure import Figure

Array = NDArray[np.float64]

MOST = 12  # parameters: 66 pairs, each 0.8 inches wide, are as many as can be read
FEWEST_SAMPLES = 100  # below that contours are noise
BINS = 30
LAPLACE = CURVES[2]
FILLS = ("white", "#d5e4ea", "#a3c5d1")  # outside, within 2 sigma, within 1: light, so that the fit is seen over it
SIGMAS = (1.0, 2.0)  # of two parameters together: 39 % and 86 % of the samples
LEFT, BOTTOM, RIGHT, TOP = 0.85, 0.85, 0.15, 0.45  # margins, inches


def draw_corner(figure: Figure) -> Canvas:
    """Return the canvas of "samples" (k, d) with what is known besides: "truth" (d,), "laplace_mean" (d,) and
    "laplace_covariance" (d, d). At most 12 parameters are drawn; the title says so where there are more."""
    samples = np.atleast_2d(np.asarray(figure.arrays["samples"], np.float64))
    samples = samples[np.isfinite(samples).all(axis=1)]
    every = samples.shape[1]
    count = min(every, MOST)
    samples = samples[:, :count]
    title = f"{figure.title}, {figure.unit}" if figure.unit else figure.title
    if every > MOST:
        title += f" (the first {MOST} of {every} parameters)"
    if count == 0 or len(samples) < FEWEST_SAMPLES:
        return _nothing(title, len(samples))
    truth = _known(figure, "truth", (every,), count)
    mean = _known(figure, "laplace_mean", (every,), count)
    covariance = _known(figure, "laplace_covariance", (every, every), count)
    ranges = [_range(samples[:, k], None if truth is None else float(truth[k])) for k in range(count)]
    panel = 3.2 if count == 1 else float(np.clip(9.0 / count, 0.8, 1.9))
    side = panel * count + 0.05 * panel * (count - 1)
    width, height = LEFT + side + RIGHT, BOTTOM + side + TOP
    canvas = Canvas(figsize=(width, height))
    names = [*figure.labels, *(f"parameter {k + 1}" for k in range(len(figure.labels), every))][:count]
    _panels(canvas, samples, ranges, names)
    axes = np.array(canvas.axes, dtype=object).reshape(count, count)
    for i, j in zip(*np.tril_indices(count), strict=True):
        if mean is not None and covariance is not None:
            _laplace(axes[i, j], mean[[j, i]], covariance[np.ix_([j, i], [j, i])], ranges[j], len(samples), i == j)
        if truth is not None:
            _truth(axes[i, j], truth[[j, i]], i == j)
    _labels_in_line(axes, panel)
    canvas.text(0.1 / width, 1 - 0.1 / height, title, ha="left", va="top", color=INK, fontsize=10)
    _legend(canvas, mean is not None and covariance is not None, truth is not None, count)
    return canvas


def _panels(canvas: Canvas, samples: Array, ranges: list[tuple[float, float]], names: list[str]) -> None:
    """Draw the histograms and the contours of the samples, and put the panels within the margins."""
    count, (width, height) = len(names), canvas.get_size_inches()
    small = {"fontsize": 9 if count < 7 else 7}
    corner.corner(
        samples,
        fig=canvas,
        bins=BINS,
        range=ranges,
        labels=names,
        label_kwargs=small,
        color=AFTER,
        smooth=1.0,
        levels=[1 - np.exp(-0.5 * s**2) for s in SIGMAS],
        max_n_ticks=3 if count < 7 else 2,
        plot_datapoints=False,  # 10 000 points in 66 panels: megabytes of dots
        plot_density=False,
        fill_contours=True,
        contourf_kwargs={"colors": FILLS},
        hist_kwargs={"linewidth": 1.3},
    )
    canvas.subplots_adjust(
        left=LEFT / width,
        right=1 - RIGHT / width,
        bottom=BOTTOM / height,
        top=1 - TOP / height,
    )


def _nothing(title: str, count: int) -> Canvas:
    canvas = Canvas(figsize=(6.4, 1.2))
    canvas.text(0.02, 0.9, title, ha="left", va="top", color=INK, fontsize=10)
    said = f"{count} samples: fewer than {FEWEST_SAMPLES} make no picture."
    canvas.text(0.02, 0.4, said, ha="left", va="center", color=MUTED)
    return canvas


def _known(figure: Figure, name: str, shape: tuple[int, ...], count: int) -> Array | None:
    """Return the drawn part of an optional array; None where it is missing, not of that shape, or not finite."""
    if name not in figure.arrays or np.shape(figure.arrays[name]) != shape:
        return None
    part = np.asarray(figure.arrays[name], np.float64)[(slice(count),) * len(shape)]
    return part if np.isfinite(part).all() else None


def _range(values: Array, truth: float | None) -> tuple[float, float]:
    """Return what is shown of a parameter: nearly all samples, and the truth unless that is far off."""
    low, high = (float(v) for v in np.quantile(values, [0.002, 0.998]))
    margin = 0.1 * (high - low) or 0.5 * abs(low) or 0.5
    low, high = low - margin, high + margin
    if truth is not None and low - (high - low) < truth < high + (high - low):
        low, high = min(low, truth - margin), max(high, truth + margin)
    return low, high


def _laplace(axes: Axes, mean: Array, covariance: Array, x: tuple[float, float], count: int, alone: bool) -> None:
    """Draw a Gaussian: as a curve of counts where a parameter is alone, else as the ellipses of 1 and 2 sigma."""
    style: dict[str, Any] = {"color": LAPLACE, "linestyle": "--", "linewidth": 1.1}
    if alone:
        at = np.linspace(*x, 200)
        sigma = np.sqrt(covariance[0, 0])
        density = np.exp(-0.5 * ((at - mean[0]) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
        curve = count * (x[1] - x[0]) / BINS * density
        axes.plot(at, curve, **style)
        axes.set_ylim(0, max(axes.get_ylim()[1], 1.1 * float(curve.max())))
        return
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 100)
    ring = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    for sigmas in SIGMAS:
        axes.plot(*(mean[:, None] + sigmas * ring), **style)


def _truth(axes: Axes, truth: Array, alone: bool) -> None:
    axes.axvline(truth[0], color=INK, linewidth=0.9)
    if not alone:
        axes.axhline(truth[1], color=INK, linewidth=0.9)
        axes.plot(truth[0], truth[1], "s", color=INK, markersize=3)


def _labels_in_line(axes: NDArray[Any], panel: float) -> None:
    """Put the names of the parameters the same 0.55 inches from the panels, whatever the size of a panel."""
    beyond = -0.55 / panel
    for one in axes[-1]:
        one.xaxis.set_label_coords(0.5, beyond)
    for one in axes[1:, 0]:
        one.yaxis.set_label_coords(beyond, 0.5)
    for one in axes.ravel():
        one.tick_params(labelsize=7, length=2)


def _legend(canvas: Canvas, laplace: bool, truth: bool, count: int) -> None:
    shown = [Line2D([], [], color=AFTER, label="samples, 1 and 2 sigma" if count > 1 else "samples")]
    if laplace:
        shown.append(Line2D([], [], color=LAPLACE, linestyle="--", label="Laplace fit"))
    if truth:
        shown.append(Line2D([], [], color=INK, linewidth=0.9, marker="s", markersize=3, label="truth"))
    if count > 1:
        canvas.legend(handles=shown, loc="upper right", frameon=False, bbox_to_anchor=(0.99, 0.93))
    elif len(shown) > 1:
        canvas.axes[0].legend(handles=shown, loc="upper right", frameon=False, fontsize=6)
