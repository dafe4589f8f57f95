"""The figures of a tolerance study: yield against scale, the benches' errors, what drives them, what is allowed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from holocal.app.report.drawing import AFTER, BEFORE, CURVES, GRID, INK, MUTED, TARGET

Array = NDArray[np.float64]

STAGES = (("before", "as built", BEFORE), ("after", "corrected", AFTER), ("pose", "own pose", CURVES[2]))
HISTOGRAMS = (
    ("wavefront_worst_rad", "worst wavefront in the field, rad rms", True),
    ("distortion_max_px", "largest distortion, camera pixels", True),
    ("nonuniformity_rms", "non-uniformity, rms", False),
    ("light_fraction", "light, of the nominal bench's", False),
    ("field_coverage", "field covered, of the nominal bench's", False),
)
DRIVEN = (
    ("wavefront_median_rad", "wavefront, rad"),
    ("distortion_rms_px", "distortion, px"),
    ("light_fraction", "light"),
    ("field_coverage", "field covered"),
)
BINS = 36
LEAST_RATIO = 0.03


def yield_against_scale(result: Mapping[str, Any]) -> Canvas:
    """Return the share of benches within the spec against the scale of all tolerances together."""
    canvas, axes = _canvas(6.8, 3.3)
    low, largest = 0.05, result["scale"]["after"]["largest"]
    for (stage, label, colour), dash in zip(STAGES, ("-", "-", (0, (4, 2))), strict=True):
        critical = result["scale"][stage]["critical"]
        ends = np.array([largest if value is None else value for value in critical])
        known = np.sort(ends[[value is not None for value in critical]])
        share = 1 - np.searchsorted(known, grid := np.geomspace(low, largest, 400), side="right") / len(critical)
        axes.plot(grid, 100 * share, color=colour, linestyle=dash, linewidth=1.8, label=label)
        axes.plot([1.0], [100 * result[stage]["yield"]], "o", color=colour, markersize=5)
    wanted = 100 * result["targets"]["yield"]
    axes.axhline(wanted, color=TARGET, linestyle=":", linewidth=1.3)
    axes.annotate(
        f"wanted {wanted:.0f} %", (0.99, wanted), xycoords=("axes fraction", "data"), ha="right", va="bottom",
        color=TARGET,
    )  # fmt: skip
    axes.axvline(1.0, color=MUTED, linewidth=0.8)
    axes.annotate("the tolerances as given", (1.0, 104), xytext=(4, 0), textcoords="offset points", ha="left",
                  va="center", color=MUTED, fontsize=8)  # fmt: skip
    _log_x(axes)
    axes.set_ylim(-3, 108)
    axes.set_xlim(low, largest)
    axes.set_xlabel("all tolerances times")
    axes.set_ylabel("benches within the spec, %")
    axes.legend(frameon=False, loc="center left")
    return canvas


def histograms(table: Mapping[str, Array], limits: Mapping[str, float]) -> Canvas:
    """Return the benches' numbers before and after correction, on the same axes, with the limits."""
    canvas, every = _canvas(9.4, 5.2, 2, 3)
    flat = every.ravel()
    for axes, (name, label, logarithmic) in zip(flat, HISTOGRAMS, strict=False):
        _histogram(axes, [table[f"{stage}_{name}"] for stage, _, _ in STAGES], logarithmic)
        if name in limits:
            axes.axvline(limits[name], color=TARGET, linestyle="--", linewidth=1.4)
        axes.set_xlabel(label)
        axes.set_ylabel("benches")
    flat[-1].axis("off")
    marks = [flat[-1].plot([], [], color=colour, linewidth=6, alpha=0.6)[0] for _, _, colour in STAGES]
    marks.append(flat[-1].plot([], [], color=TARGET, linestyle="--")[0])
    flat[-1].legend(marks, [*(label for _, label, _ in STAGES), "limit"], frameon=False, loc="center left")
    return canvas


def _histogram(axes: Axes, values: Sequence[Array], logarithmic: bool) -> None:
    known = [one[np.isfinite(one) & ((one > 0) | (not logarithmic))] for one in values]
    together = np.concatenate(known)
    if not len(together):
        return
    low, high = float(together.min()), float(together.max())
    high = high if high > low else low + 1.0
    bins = (np.geomspace if logarithmic else np.linspace)(low, high, BINS + 1).tolist()
    for one, (_, _, colour) in zip(known, STAGES, strict=True):
        if len(one):
            axes.hist(one, bins=bins, color=colour, alpha=0.55, histtype="stepfilled", linewidth=0)
            axes.hist(one, bins=bins, color=colour, histtype="step", linewidth=1.2)
    if logarithmic:
        _log_x(axes)


def sensitivities(result: Mapping[str, Any]) -> Canvas:
    """Return what share of each error comes from each degree of freedom, with its tolerance."""
    freedoms = result["freedoms"]
    canvas, every = _canvas(9.4, 3.9, 1, len(DRIVEN), sharey=True)
    rows = np.arange(len(freedoms))
    for axes, (name, label) in zip(every.ravel(), DRIVEN, strict=True):
        share = np.array([100 * one["share"][name] for one in freedoms.values()])
        top = int(np.argmax(share))
        colours = [AFTER if row == top else "#8fb7c4" for row in rows]
        axes.barh(rows, share, color=colours, height=0.7)
        for row, value in enumerate(share):
            if value >= 1:
                axes.annotate(f"{value:.0f}", (value, row), xytext=(2, 0), textcoords="offset points", va="center",
                              fontsize=7.5, color=INK)  # fmt: skip
        axes.set_title(label, loc="left")
        axes.set_xlabel("% of the squared error")
        axes.set_xlim(0, max(10.0, 1.18 * float(share.max())))
        axes.grid(axis="y", visible=False)
    first = every.ravel()[0]
    first.set_yticks(rows, [_readable(name) for name in freedoms])
    first.invert_yaxis()
    return canvas


def allowed(result: Mapping[str, Any]) -> Canvas | None:
    """Return each tolerance as given beside the one that correction stands, the others being perfect."""
    chosen = {name: one for name, one in result["freedoms"].items() if one["allowed"]["after"] is not None}
    if not chosen:
        return None
    canvas, axes = _canvas(6.8, 0.9 + 0.27 * len(chosen))
    rows = np.arange(len(chosen))
    for (stage, label, colour), shift in zip(STAGES, (-0.22, 0.0, 0.22), strict=True):
        for row, one in zip(rows, chosen.values(), strict=True):
            said = one["allowed"][stage]
            open_ = said["tolerance"] is None
            ratio = (said["tried_to"] if open_ else said["tolerance"]) / one["tolerance"]
            marker = ">" if open_ else "o" if ratio > LEAST_RATIO else "<"
            axes.plot([max(ratio, LEAST_RATIO)], [row + shift], marker=marker, color=colour, markersize=5,
                      linestyle="", label=label if row == 0 else None)  # fmt: skip
    axes.axvline(1.0, color=MUTED, linewidth=1.0)
    _log_x(axes)
    axes.set_yticks(rows, [_readable(name) for name in chosen])
    axes.set_ylim(len(chosen) - 0.5, -0.5)
    axes.set_xlabel(
        "tolerance alone, of the one given, at the wanted yield\n"
        "(> more than was tried, < none: the drawing itself misses the spec)"
    )
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return canvas


def failures(result: Mapping[str, Any]) -> Canvas | None:
    """Return how many benches fail for each reason, corrected and with a hologram of their own; None where none do."""
    reasons = list(dict.fromkeys([*result["after"]["failures"], *result["pose"]["failures"]]))
    if not reasons:
        return None
    canvas, axes = _canvas(6.8, 0.9 + 0.42 * len(reasons))
    for (stage, label, colour), shift in zip(STAGES[1:], (-0.18, 0.18), strict=True):
        share = [100 * result[stage]["failures"].get(reason, 0) / result["benches"] for reason in reasons]
        axes.barh(np.arange(len(reasons)) + shift, share, height=0.34, color=colour, label=label)
    axes.set_yticks(range(len(reasons)), reasons)
    axes.set_ylim(len(reasons) - 0.5, -0.5)
    axes.set_xlim(0, 105)
    axes.set_xlabel("benches that fail for it, % (a bench may have several reasons)")
    axes.legend(frameon=False, loc="lower right")
    axes.grid(axis="y", visible=False)
    return canvas


def _readable(name: str) -> str:
    """Return a degree of freedom as it is read: ``mirror_rx_deg`` is "mirror turn x"."""
    part, way, _ = name.split("_")
    return f"{'SLM' if part == 'slm' else part} {'turn' if way[0] == 'r' else 'shift'} {way[1]}"


def _log_x(axes: Axes) -> None:
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    few = high / max(low, 1e-12) < 300
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _canvas(
    width: float, height: float, rows: int = 1, columns: int = 1, *, sharey: bool = False
) -> tuple[Canvas, Any]:
    canvas = Canvas(figsize=(width, height), layout="constrained")
    every = canvas.subplots(rows, columns, sharey=sharey)
    for axes in np.atleast_1d(np.asarray(every, dtype=object)).ravel():
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)
    return canvas, every
