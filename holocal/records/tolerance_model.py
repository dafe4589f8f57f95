"""A tolerance file as a typed model: how far each degree of freedom may be off, and what an image must meet.

Each list is [x, y, z], in the frames of `holocal.optics.bench.Pose`: of a normal distribution one standard deviation,
of a uniform one the limit on both sides of 0.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from holocal.errors import ConfigError
from holocal.records.reading import checked_text
from holocal.records.rig_model import Table
from holocal.records.validate import validated

SCHEMA = 1
LARGEST_FILE_BYTES = 2**20

Degrees = Annotated[float, Field(ge=0.0, le=10.0)]
Millimetres = Annotated[float, Field(ge=0.0, le=10.0)]
Share = Annotated[float, Field(gt=0.0, le=1.0)]
Distribution = Literal["normal", "uniform"]


class PartTable(Table):
    """``[mirror]`` or ``[slm]``: what a part's mounting leaves of its rotation and its place."""

    rotation_deg: tuple[Degrees, Degrees, Degrees]
    shift_mm: tuple[Millimetres, Millimetres, Millimetres]
    distribution: Distribution | None = None  # None: the file's


class SpecTable(Table):
    """``[spec]``: what an image must meet; a limit that is left out is not judged.

    Wavefront errors, distortion and non-uniformity have largest values, `light_fraction` and `field_coverage` smallest;
    `nyquist_use` is the highest spatial frequency of the hologram over the panel's.
    """

    wavefront_median_rad: float | None = Field(default=None, gt=0.0)
    wavefront_worst_rad: float | None = Field(default=0.45, gt=0.0)
    distortion_rms_px: float | None = Field(default=None, gt=0.0)
    distortion_max_px: float | None = Field(default=1.0, gt=0.0)
    nonuniformity_rms: float | None = Field(default=0.1, gt=0.0)
    light_fraction: Share | None = 0.25
    field_coverage: Share | None = 0.5
    nyquist_use: float | None = Field(default=1.0, gt=0.0)

    @model_validator(mode="after")
    def _judges_something(self) -> SpecTable:
        if not self.limits():
            raise ValueError("it gives no limit")
        return self

    def limits(self) -> dict[str, float]:
        """Return the limits that are judged."""
        return {name: value for name, value in self if value is not None}


class Tolerances(Table):
    """A whole tolerance file. The defaults are a bench put together with care, without an autocollimator."""

    distribution: Distribution = "normal"
    wanted_yield: float = Field(default=0.95, gt=0.0, lt=1.0)
    mirror: PartTable = PartTable(rotation_deg=(0.3, 0.3, 0.3), shift_mm=(0.3, 0.3, 0.3))
    slm: PartTable = PartTable(rotation_deg=(0.5, 0.5, 0.5), shift_mm=(0.5, 0.5, 0.5))
    spec: SpecTable = SpecTable()

    @model_validator(mode="after")
    def _something_varies(self) -> Tolerances:
        if not any(width for _, width, _ in self.freedoms()):
            raise ValueError("every tolerance is 0: all benches would be the drawing's")
        return self

    def freedoms(self) -> Iterator[tuple[str, float, Distribution]]:
        """Yield name, width (degrees or millimetres) and distribution of the twelve degrees of freedom."""
        for name, part in (("mirror", self.mirror), ("slm", self.slm)):
            law = part.distribution or self.distribution
            for letter, unit, widths in (("r", "deg", part.rotation_deg), ("d", "mm", part.shift_mm)):
                for axis, width in zip("xyz", widths, strict=True):
                    yield f"{name}_{letter}{axis}_{unit}", width, law


class Study(Table):
    """Everything that decides a study's numbers, beside the rig and the seed.

    `benches` are drawn as the tolerances say; the first `scaled` of them again at every one of a ladder of scales.
    """

    benches: int = Field(default=500, ge=1, le=1_000_000)
    scaled: int = Field(default=100, ge=1, le=100_000)
    wavelength_nm: float = Field(default=515.0, ge=200.0, le=12000.0)
    tolerances: Tolerances = Tolerances()


def read_tolerances(path: Path | None, overrides: Mapping[str, Any] | None = None) -> Tolerances:
    """Return the tolerances of a TOML file, or the defaults, with dotted keys overridden.

    Raises
    ------
    ConfigError
        The file cannot be read or is not TOML, a key is unknown or a value impossible.
    """
    tables: dict[str, Any] = {}
    source = "the default tolerances" if path is None else str(path)
    if path is not None:
        text = checked_text(
            path,
            largest_bytes=LARGEST_FILE_BYTES,
            what="a tolerance file",
            fix="Give the TOML file that lists the tolerances.",
            error=ConfigError,
        )
        try:
            tables = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{source} is not a TOML file: {error}.", fix="Correct that line.") from error
    schema = tables.pop("schema", SCHEMA)
    if type(schema) is not int or schema != SCHEMA:
        raise ConfigError(
            f"{source}: schema is {schema!r}; this holocal reads schema {SCHEMA}.",
            fix=f"Write schema = {SCHEMA}, or leave it out.",
            measured=schema,
            limit=SCHEMA,
        )
    for key, value in (overrides or {}).items():
        _set(tables, key, value, source)
    return validated(Tolerances, tables, source=source, origins={key: f"--set {key}" for key in overrides or {}})


def _set(tables: dict[str, Any], key: str, value: Any, source: str) -> None:
    *parents, last = key.split(".")
    for part in parents:
        inner = tables.setdefault(part, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"--set {key}: {part} is a value in {source}, not a table.")
        tables = inner
    tables[last] = value
