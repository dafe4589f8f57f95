"""What a run holds, as named arrays: maps, the pictures before and after, tables, numbers, the report's data.

A name is a path: ``maps/valid``, ``result/after/rms_px``, ``steps/value``. Every array has a unit and, for each of its
dimensions, the name of the array that it runs along. What belongs to one procedure of a run of several begins with its
name: ``response/maps/correction.phase_rad``. A list of records is a column per key; None is NaN; a text is left
to the documents, which hold the run's own files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.loop.figures import read_figures
from holocal.loop.record import read_journal
from holocal.records.files import dump_json, read_json
from holocal.records.manifest import require_intact
from holocal.records.maps import Maps, read_maps
from holocal.records.reading import reading
from holocal.records.run_files import parts_of
from holocal.units import DEGREE, unit_of

SCHEMA = 1
Extent = tuple[float, float, float, float]
IMAGES = ("maps", "before", "after")  # the run's OpenEXR files
DOCUMENTS = ("config.toml", "identity.json", "environment.json", "preflight.json", "result.json")


@dataclass(frozen=True)
class Quantity:
    """An array of numbers or texts with its unit, and the names of those that its dimensions run along."""

    values: NDArray[Any]
    unit: str = ""
    axes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Contents:
    """What a run holds: `quantities` by name, `documents` (file -> text), `images`, and `about` the run itself."""

    quantities: Mapping[str, Quantity]
    documents: Mapping[str, str]
    images: Mapping[str, Maps]
    about: Mapping[str, Any]


def contents_of(run: Path) -> Contents:
    """Return what a finished run holds; `InputError` when a file is not what was written, or it found nothing."""
    manifest = require_intact(run)
    if not (run / "result.json").is_file():
        raise InputError(
            f"{run.name} has no result: its status is {manifest['status']!r}.",
            fix=f"`holocal report {run}` says why; `holocal resume {run}` goes on where that is possible.",
            code="no-result",
        )
    result = read_json(run / "result.json")
    images: dict[str, Maps] = {}
    quantities: dict[str, Quantity] = {}
    for prefix, directory in {"": run, **{f"{name}/": part for name, part in parts_of(run).items()}}.items():
        images |= {
            f"{prefix}{name}": read_maps(path) for name in IMAGES if (path := directory / f"{name}.exr").is_file()
        }
        tree = _of_tree(read_json(directory / "result.json"), "")
        quantities |= {f"{prefix}result/{name}": found for name, found in tree.items()}
    for name, image in images.items():
        quantities |= _of_image(name, image)
    quantities |= _of_steps(run) | _of_figures(run)
    about = {"schema": SCHEMA, "run": run.name} | {
        key: result.get(key) for key in ("procedure", "rig", "targets_met", "sentence", "seed", "corrections")
    }
    return Contents(quantities, _documents(run), images, about)


def index_of(contents: Contents) -> str:
    """Return units and axes of every quantity, and what the run is, as one JSON text."""
    listed = {
        name: {"unit": one.unit, "axes": list(one.axes), "shape": list(one.values.shape)}
        for name, one in contents.quantities.items()
    }
    return dump_json({**contents.about, "quantities": listed})


def _documents(run: Path) -> dict[str, str]:
    found = {}
    parts = [f"{name}/result.json" for name in parts_of(run)]
    for name in (*DOCUMENTS, *parts):
        if (run / name).is_file():
            with reading(run / name):
                found[name] = (run / name).read_text(encoding="utf-8")
    return found


def _of_image(name: str, image: Maps) -> dict[str, Quantity]:
    """Return the channels of an image and its two axes: field angles where the file says what it covers."""
    shape = next(iter(image.channels.values())).shape
    said = image.metadata.get("axes")
    titles = (str(said[0]), str(said[1])) if isinstance(said, list) and len(said) == 2 else ("row", "column")
    axes = _axes(name, (shape[0], shape[1]), image.extent_deg, titles)
    units = image.metadata.get("units", {})
    channels = {
        f"{name}/{channel}": Quantity(values, str(units.get(channel, unit_of(channel))), tuple(axes))
        for channel, values in image.channels.items()
    }
    return axes | channels


def _axes(
    name: str, shape: tuple[int, int], extent_deg: Extent | None, titles: tuple[str, str] = ("row", "column")
) -> dict[str, Quantity]:
    """Return the two axes of an image, rows first."""
    along = tuple(np.arange(size, dtype=np.float64) for size in shape)
    unit = ""
    if extent_deg is not None:
        left, right, bottom, top = (float(np.tan(angle * DEGREE)) for angle in extent_deg)
        titles, unit = ("y_deg", "x_deg"), "deg"
        along = (_angles(top, bottom, shape[0]), _angles(left, right, shape[1]))
    return {
        f"{name}/{title}": Quantity(values, unit, (f"{name}/{title}",))
        for title, values in zip(titles, along, strict=True)
    }


def _angles(first_tan: float, last_tan: float, count: int) -> NDArray[np.float64]:
    """Return the field angles of pixel centres, degrees: pixels are even in tangents."""
    at = (np.arange(count) + 0.5) / count
    return np.asarray(np.arctan(first_tan + (last_tan - first_tan) * at) / DEGREE)


def _of_tree(value: Any, name: str) -> dict[str, Quantity]:
    if isinstance(value, Mapping):
        found: dict[str, Quantity] = {}
        for key, item in value.items():
            found |= _of_tree(item, f"{name}/{str(key).replace('/', '_')}" if name else str(key).replace("/", "_"))
        return found
    if isinstance(value, str):
        return {}
    if isinstance(value, list):
        return _of_list(value, name)
    return {name: Quantity(np.float64(np.nan if value is None else value) * np.ones(()), unit_of(name))}


def _of_list(values: Sequence[Any], name: str) -> dict[str, Quantity]:
    if not values:
        return {}
    if all(isinstance(item, Mapping) for item in values):
        keys = list(dict.fromkeys(key for item in values for key in item))
        return _of_tree({key: [item.get(key) for item in values] for key in keys}, name)
    if all(isinstance(item, str) for item in values):
        return {name: Quantity(np.array(values))}
    try:
        array = np.array(values, dtype=np.float64)  # None becomes NaN
    except (TypeError, ValueError):  # of several lengths, or mixed: it stays in result.json alone
        return {}
    return {name: Quantity(array, unit_of(name))}


def _of_steps(run: Path) -> dict[str, Quantity]:
    """Return the goal's number of every step, with its sigma and its target."""
    steps = [
        line for line in read_journal(run) if line["event"] == "step" and isinstance(line.get("progress"), Mapping)
    ]
    if not steps:
        return {}
    said = {name: [line["progress"].get(name) for line in steps] for name in ("quantity", "value", "sigma", "target")}
    columns = _of_tree({"step": [line.get("step") for line in steps], **said}, "steps")
    return {name: Quantity(one.values, one.unit, ("steps/step",)) for name, one in columns.items()}


def _of_figures(run: Path) -> dict[str, Quantity]:
    """Return the data of the report's figures: a curve runs along its x, a picture over its field."""
    found: dict[str, Quantity] = {}
    for figure in read_figures(run):
        name = f"figures/{figure.name}"
        shapes = {np.shape(values) for values in figure.arrays.values()}
        whole = len(shapes) == 1 and figure.extent_deg is not None and len(min(shapes)) == 2
        axes = _axes(name, next(iter(shapes)), figure.extent_deg) if whole else {}
        for key, values in figure.arrays.items():
            along = "x" in figure.arrays and np.shape(values) == np.shape(figure.arrays["x"])
            unit = "" if key in ("x", "valid") else figure.unit
            found[f"{name}/{key}"] = Quantity(np.asarray(values), unit, (f"{name}/x",) if along else tuple(axes))
        found |= axes
    return found
