"""The report of a tolerance study, from its `result.json` and `benches.csv`."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from holocal.app.report import study_figures
from holocal.app.report.drawing import STYLE, data_uri
from holocal.app.report.page import command, filled
from holocal.records.files import read_json

LABELS = {
    "wavefront_median_rad": "wavefront, median over the field, rad rms",
    "wavefront_worst_rad": "wavefront, worst in the field, rad rms",
    "distortion_rms_px": "distortion, rms, camera pixels",
    "distortion_max_px": "distortion, largest, camera pixels",
    "nonuniformity_rms": "non-uniformity, rms over mean",
    "light_fraction": "light, of the nominal bench's",
    "field_coverage": "field covered, of the nominal bench's",
    "nyquist_use": "spatial frequency, of the panel's highest",
}


def study_page(directory: Path, config: Mapping[str, Any]) -> str:
    """Return the report as HTML; of a study that was cut off, one that says so."""
    path = directory / "result.json"
    error = directory / "error.json"
    common = {
        "run": directory.name,
        "config": config,
        "command": command(config),
        "environment": read_json(directory / "environment.json"),
        "labels": LABELS,
    }
    if not path.is_file():
        said = read_json(error)["what"] if error.is_file() else "The study was cut off."
        return filled("study.html", **common, result=None, said=said, figures=[], rows=[])
    result = read_json(path)
    return filled(
        "study.html",
        **common,
        result=result,
        said=result["sentence"],
        figures=_figures(result, read_benches(directory / "benches.csv")),
        rows=[(name, LABELS[name], result["targets"].get(name)) for name in result["before"]["spread"]],
    )


def read_benches(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the columns of numbers of ``benches.csv``, (benches,) each; NaN where a cell is empty."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    words = ("_within", "_misses")
    names = [name for name in rows[0] if not name.endswith(words)]
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}


def _figures(result: Mapping[str, Any], table: Mapping[str, NDArray[np.float64]]) -> list[dict[str, str]]:
    largest = max(result["freedoms"].items(), key=lambda item: item[1]["share"]["distortion_rms_px"])[0]
    listed: tuple[tuple[str, str, Callable[[], Canvas | None]], ...] = (
        (
            "Yield against the scale of the tolerances",
            "Share of benches within the spec when all tolerances are multiplied by one number; the dots are all "
            f"{result['benches']} benches at the tolerances as given.",
            lambda: study_figures.yield_against_scale(result),
        ),
        (
            "Why benches fail after correction",
            "What correction by hologram does not bring back.",
            lambda: study_figures.failures(result),
        ),
        (
            "The benches before and after correction",
            "Same axes for all three; the dashed line is the limit of the spec. A number that is 0 has no place on a "
            "logarithmic axis: a hologram of the bench's own pose leaves no wavefront error and no distortion.",
            lambda: study_figures.histograms(table, result["targets"]),
        ),
        (
            "What drives the errors",
            "Share of each degree of freedom in the squared error as built: its finite difference times its tolerance. "
            f"Most of the distortion comes from {largest}.",
            lambda: study_figures.sensitivities(result),
        ),
        (
            "What each degree of freedom may have alone",
            "The tolerance at which the wanted yield is just reached when all others are perfect, over the one given.",
            lambda: study_figures.allowed(result),
        ),
    )
    made = []
    with rc_context(STYLE):
        for title, caption, draw in listed:
            canvas = draw()
            if canvas is not None:
                made.append({"title": title, "caption": caption, "data": data_uri(canvas)})
    return made
