"""The views of a light field, listed in a TOML file: ``[[view]]`` tables."""

from __future__ import annotations

from itertools import combinations
from math import dist, inf
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from holocal.errors import InputError
from holocal.records.rig_model import Table
from holocal.records.scene import LARGEST_PIXELS, check_size, read_scene
from holocal.records.scene_data import LightField, View
from holocal.records.scene_toml import checked, named_file, of_one_size, read_tables
from holocal.units import MM

PupilMm = Annotated[float, Field(ge=-10.0, le=10.0)]


class LightFieldTable(Table):
    """The file: see `scene_data.LightField`. `aperture_mm` is by default the smallest distance between two views."""

    view: tuple[dict[str, Any], ...] = Field(min_length=1, max_length=1024)
    distance_m: float = Field(default=inf, gt=0.0, allow_inf_nan=True)
    aperture_mm: float | None = Field(default=None, gt=0.0, le=20.0)
    converging: bool = False


class ViewTable(Table):
    """``[[view]]``: an image, and the centre (x, y) in the pupil that it was seen from."""

    image: str
    pupil_mm: tuple[PupilMm, PupilMm]


def read_light_field(path: Path, *, srgb: bool = False) -> LightField:
    """Return the views that a TOML file lists; paths are relative to it.

    Parameters
    ----------
    srgb
        Undo the sRGB transfer curve of the images.

    Raises
    ------
    InputError
        The file or a view is absent or damaged, views differ in size or share a place, none has light.
    """
    file = checked(LightFieldTable, read_tables(path), source=str(path))
    sources = [f"{path}, view {number}" for number in range(1, len(file.view) + 1)]
    tables = [checked(ViewTable, one, source=source) for one, source in zip(file.view, sources, strict=True)]
    files = [
        named_file(path, one.image, source=source, key="image") for one, source in zip(tables, sources, strict=True)
    ]
    aperture_mm = file.aperture_mm or _nearest_mm(path, tables)
    _check_memory(path, files)
    views: list[View] = []
    for table, source, image_file in zip(tables, sources, files, strict=True):
        image = read_scene(image_file, srgb=srgb, allow_black=True)
        if views:
            of_one_size(image.shape, views[0].intensity.shape, source=source, what=f"image = {table.image!r}")
        views.append(View(image, (table.pupil_mm[0] * MM, table.pupil_mm[1] * MM)))
    if not any(view.intensity.any() for view in views):
        raise InputError(f"{path}: every view is black.", why="There is no light to form.", measured=0.0)
    aperture_m = None if aperture_mm is None else aperture_mm * MM
    return LightField(tuple(views), file.distance_m, aperture_m, file.converging)


def _nearest_mm(path: Path, tables: list[ViewTable]) -> float | None:
    """Return the smallest distance between two views, None for one view."""
    if len(tables) == 1:
        return None
    (one, other), nearest = min(
        (((i, j), dist(tables[i].pupil_mm, tables[j].pupil_mm)) for i, j in combinations(range(len(tables)), 2)),
        key=lambda pair: pair[1],
    )
    if nearest < 1e-3:  # a micrometre: two wavelengths
        raise InputError(
            f"{path}: views {one + 1} and {other + 1} are {nearest:g} mm apart, "
            f"at pupil_mm = {list(tables[one].pupil_mm)}.",
            fix="Give each view its own place, or set aperture_mm.",
            measured=nearest,
            limit=1e-3,
        )
    return nearest


def _check_memory(path: Path, files: list[Path]) -> None:
    spec = check_size(files[0])
    pixels = spec.width * spec.height * len(files)
    if pixels > LARGEST_PIXELS:
        raise InputError(
            f"{path}: {len(files)} views of {spec.width} x {spec.height} are {pixels / 1e6:.0f} million pixels.",
            fix="Give fewer or smaller views; a view through 1 mm resolves 850 directions in 25 degrees.",
            measured=pixels,
            limit=LARGEST_PIXELS,
        )
