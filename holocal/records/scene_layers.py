"""Images with depths, listed in a TOML file: ``[[layer]]`` tables, or one ``[rgbd]`` table."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from holocal.errors import InputError
from holocal.records.maps import read_maps
from holocal.records.rig_model import Table
from holocal.records.scene import check_size, read_scene
from holocal.records.scene_data import Array, DepthImage, Image, Layer, Layers
from holocal.records.scene_toml import checked, named_file, of_one_size, read_tables


class LayersTable(Table):
    """The file: layers or an image with depths, not both. `occlusion`: see `scene_data.Layers`."""

    layer: tuple[dict[str, Any], ...] = Field(default=(), max_length=1000)
    rgbd: dict[str, Any] | None = None
    occlusion: bool | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> LayersTable:
        if bool(self.layer) == (self.rgbd is not None):
            raise ValueError(
                "the file has [[layer]] tables or one [rgbd] table, " + ("not both" if self.layer else "here neither")
            )
        if self.rgbd is not None and self.occlusion is not None:
            raise ValueError("occlusion is for [[layer]] tables; an [rgbd] image has one depth per direction")
        return self


class LayerTable(Table):
    """``[[layer]]``: an image in the plane at `depth_m`; its intensities are multiplied by `intensity`."""

    image: str
    depth_m: float = Field(gt=0.0, allow_inf_nan=True)
    mask: str | None = None
    intensity: float = Field(default=1.0, gt=0.0)


class RgbdTable(Table):
    """``[rgbd]``: an image and its depths: metres in an EXR file, else linear in dioptres, 0 `far_m`, full `near_m`."""

    image: str
    depth: str
    layers: int = Field(ge=1, le=1000)
    near_m: float | None = Field(default=None, gt=0.0)
    far_m: float | None = Field(default=None, gt=0.0, allow_inf_nan=True)

    @property
    def in_metres(self) -> bool:
        """Whether the depth file holds metres."""
        return Path(self.depth).suffix.lower() == ".exr"

    @model_validator(mode="after")
    def _depths_have_a_scale(self) -> RgbdTable:
        given = [value is not None for value in (self.near_m, self.far_m)]
        if self.in_metres and any(given):
            raise ValueError("near_m and far_m are for depths in a PNG; an EXR file holds metres")
        if not self.in_metres and not all(given):
            raise ValueError("near_m and far_m are needed: a PNG's depths are linear in dioptres between them")
        if self.near_m is not None and self.far_m is not None and not self.near_m < self.far_m:
            raise ValueError(f"near_m = {self.near_m:g} is not below far_m = {self.far_m:g}")
        return self


def read_layers(path: Path, *, srgb: bool = False) -> Layers | DepthImage:
    """Return the layers, or the image with depths, that a TOML file lists; paths are relative to it.

    Parameters
    ----------
    srgb
        Undo the sRGB transfer curve of the images; never of masks and depths.

    Raises
    ------
    InputError
        The file or one that it names is absent, damaged or does not fit; no layer has light.
    """
    file = checked(LayersTable, read_tables(path), source=str(path))
    if file.rgbd is not None:
        table = checked(RgbdTable, file.rgbd, source=f"{path}, [rgbd]")
        return _depth_image(path, table, srgb=srgb)
    layers = tuple(_layer(path, number, tables, srgb=srgb) for number, tables in enumerate(file.layer, 1))
    if not any(_light(layer).any() for layer in layers):
        raise InputError(f"{path}: every layer is black.", why="There is no light to form.", measured=0.0)
    return Layers(layers, file.occlusion)


def _layer(path: Path, number: int, tables: dict[str, Any], *, srgb: bool) -> Layer:
    source = f"{path}, layer {number}"
    table = checked(LayerTable, tables, source=source)
    image = read_scene(named_file(path, table.image, source=source, key="image"), srgb=srgb, allow_black=True)
    mask = None
    if table.mask is not None:
        mask = read_scene(named_file(path, table.mask, source=source, key="mask"), allow_black=True)
        of_one_size(mask.shape, image.shape, source=source, what=f"mask = {table.mask!r}")
        if mask.max() > 1:
            raise InputError(
                f"{source}: mask = {table.mask!r} has values up to {mask.max():g}.",
                why="A mask says how much of what lies behind is hidden, 0 to 1.",
                measured=float(mask.max()),
                limit=1.0,
            )
    return Layer(image * np.float32(table.intensity), table.depth_m, mask)


def _light(layer: Layer) -> Image:
    return layer.intensity if layer.mask is None else layer.intensity * layer.mask


def _depth_image(path: Path, table: RgbdTable, *, srgb: bool) -> DepthImage:
    source = f"{path}, [rgbd]"
    image = read_scene(named_file(path, table.image, source=source, key="image"), srgb=srgb)
    file = named_file(path, table.depth, source=source, key="depth")
    if table.in_metres:
        depth = _metres(file)
    else:
        nearest, farthest = 1 / (table.near_m or inf), 1 / (table.far_m or inf)
        dioptres = farthest + read_scene(file, allow_black=True).astype(np.float64) * (nearest - farthest)
        with np.errstate(divide="ignore"):
            depth = 1 / dioptres
    of_one_size(depth.shape, image.shape, source=source, what=f"depth = {table.depth!r}")
    return DepthImage(image, depth, table.layers)


def _metres(file: Path) -> Array:
    """Return the one channel of an EXR file, or its Z, as depths."""
    check_size(file)
    channels = read_maps(file).channels
    name = next(iter(channels)) if len(channels) == 1 else "Z"
    if name not in channels:
        raise InputError(
            f"{file} has the channels {', '.join(channels)}; depths are in its only channel, or in Z.",
            fix="Name the channel of depths Z.",
            measured=list(channels),
        )
    depth = channels[name].astype(np.float64)
    wrong = int(np.count_nonzero(~(depth > 0)))  # NaN too
    if wrong:
        raise InputError(
            f"{file} has {wrong} depths that are NaN or not above 0 m.",
            fix="Set what is far away to inf.",
            measured=wrong,
            limit=0,
        )
    return depth
