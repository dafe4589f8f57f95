"""The history of a rig as a picture: per procedure its number over time, sigma, target, and what is in force."""

from __future__ import annotations

import io
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure as Canvas

from holocal.app.history import IN_FORCE, Check, History, Line
from holocal.app.report.drawing import AFTER, BEFORE, DPI, GRID, MUTED, STYLE, TARGET
from holocal.errors import InputError
from holocal.records.files import write_bytes

UTC_FORMAT = "%Y-%m-%dT%H:%M:%SZ"
CHECK = "#7a5195"
LEAST_MARGIN = timedelta(minutes=10)  # of the time axis: runs of one minute are one place
PANEL_INCHES = (7.2, 2.4)


def write_plot(history: History, path: Path) -> None:
    """Write the history as a PNG; `InputError` when no run has a number to draw."""
    if path.suffix.lower() != ".png":
        raise InputError(f"{path} is not named .png.", fix="Use --plot FILE.png.")
    panels: dict[str, list[Line]] = {}
    whole = {line.run.name.partition(".")[0] for line in history.lines if "." in line.run.name}  # drawn by their parts
    for line in history.lines:
        if line.main is not None and line.run.utc and line.run.name not in whole:
            panels.setdefault(line.run.procedure, []).append(line)
    if not panels:
        raise InputError(f"no run of {history.rig} has a number to draw.", fix="`holocal history` lists what there is.")
    from matplotlib import rc_context

    with rc_context(STYLE):
        write_bytes(path, _drawn(history.rig, panels, history.checks))


def _drawn(rig: str, panels: dict[str, list[Line]], checks: Sequence[Check]) -> bytes:
    canvas = Canvas(figsize=(PANEL_INCHES[0], PANEL_INCHES[1] * len(panels)), layout="constrained")
    FigureCanvasAgg(canvas)
    every = canvas.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (procedure, lines) in zip(every, panels.items(), strict=True):
        _panel(axes, procedure, lines)
        _checks(axes, [one for one in checks if one.procedure == procedure])
        _finish(axes)
    times = [datetime.strptime(line.run.utc, UTC_FORMAT) for lines in panels.values() for line in lines]
    times += [datetime.strptime(one.utc, UTC_FORMAT) for one in checks if one.procedure in panels]
    margin = max(0.04 * (max(times) - min(times)), LEAST_MARGIN)
    every[-1].set_xlim(min(times) - margin, max(times) + margin)
    every[-1].set_xlabel("UTC", color=MUTED)
    canvas.suptitle(f"{rig}: runs in time", x=0.01, ha="left", fontsize=11)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


def _panel(axes: Any, procedure: str, lines: Sequence[Line]) -> None:
    """Draw a procedure's number before and after each run; filled where it is in force."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    known = [(line, line.main) for line in lines if line.main is not None]
    when = np.array([datetime.strptime(line.run.utc, UTC_FORMAT) for line, _ in known])
    before = np.array([np.nan if main[1] is None else main[1].value for _, main in known])
    after = np.array([main[2].value for _, main in known])
    sigma = np.array([main[2].sigma or 0.0 for _, main in known])
    axes.plot(when, before, "o", color=BEFORE, markersize=3.5, alpha=0.7, label="before")
    axes.errorbar(when, after, yerr=sigma, fmt="o-", mfc="white", color=AFTER, ms=5, capsize=3, lw=1.2, label="after")
    accepted = np.array([line.accepted == IN_FORCE for line, _ in known])
    if accepted.any():
        axes.plot(when[accepted], after[accepted], "o", color=AFTER, ms=7, zorder=4, label="in force")
    targets = [main[2].target for _, main in known]
    if targets[-1] is not None:
        axes.axhline(targets[-1], color=TARGET, linestyle="--", linewidth=1.3, label=f"target {targets[-1]:.3g}")
    axes.set_title(f"{procedure}: {known[-1][1][0]}", loc="left")


def _checks(axes: Any, checks: Sequence[Check]) -> None:
    """Draw what the checks found of the accepted runs."""
    known = [(datetime.strptime(one.utc, UTC_FORMAT), one.main[1]) for one in checks if one.main is not None]
    if not known:
        return
    when = np.array([time for time, _ in known])
    values = np.array([number.value for _, number in known])
    sigma = np.array([number.sigma or 0.0 for _, number in known])
    axes.errorbar(when, values, yerr=sigma, fmt="D", color=CHECK, ms=4.5, capsize=2, lw=1.0, label="check")


def _finish(axes: Any) -> None:
    drawn = np.concatenate([np.asarray(line.get_ydata(), np.float64) for line in axes.lines])
    drawn = drawn[np.isfinite(drawn)]
    if drawn.min() > 0 and drawn.max() > 10 * drawn.min():
        axes.set_yscale("log")
    locator = AutoDateLocator(maxticks=8)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
