"""OpenEXR files of named channels: lossless, with units and axes, the same bytes for the same data.

Channels come back from the library in another order than they were written, so they are always read by name; the
library adds the time of writing by itself, so it is set.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio  # noqa: N813 - its usual name
from numpy.typing import NDArray

from holocal.errors import InputError, StorageError
from holocal.records.files import atomic_path, json_ready, one_line, storage_error

SCHEMA = 1
PREFIX = "holocal:"
FIXED_TIME = "2000:01:01 00:00:00"  # equal data give equal bytes
LARGEST_PIXELS = 2**28  # 16384 x 16384


@dataclass(frozen=True)
class Maps:
    """Channels of an EXR file, each (height, width) float32, row 0 on top; and its metadata."""

    channels: Mapping[str, NDArray[np.float32]]
    metadata: Mapping[str, Any] = field(default_factory=dict)

    @property
    def extent_deg(self) -> tuple[float, float, float, float] | None:
        """Left, right, bottom, top in degrees, where the file says so."""
        value = self.metadata.get("extent_deg")
        return (float(value[0]), float(value[1]), float(value[2]), float(value[3])) if value else None


def write_maps(
    path: Path,
    channels: Mapping[str, NDArray[Any]],
    *,
    units: Mapping[str, str] | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Write channels of one shape as 32-bit float OpenEXR, losslessly compressed, whole or not at all.

    Parameters
    ----------
    channels
        Name -> (height, width) array; written as float32.
    units
        Name -> unit, kept in the metadata.
    metadata
        Further metadata: JSON-ready values, for example ``extent_deg``.
    """
    spec, pixels = _image(path, channels, {"units": dict(units or {}), **(metadata or {})})
    with atomic_path(path) as temporary:
        _write(temporary, path, [spec], [pixels])


def write_parts(path: Path, parts: Mapping[str, Maps]) -> None:
    """Write images of different shapes as the named parts of one OpenEXR file, whole or not at all.

    A part's metadata are its own; its window is the upper left corner of one that all parts share.
    """
    specs, pictures = [], []
    for name, part in parts.items():
        spec, pixels = _image(path, part.channels, part.metadata)
        spec.attribute("oiio:subimagename", name)
        specs.append(spec)
        pictures.append(pixels)
    for spec in specs:
        spec.full_width, spec.full_height = max(one.width for one in specs), max(one.height for one in specs)
    with atomic_path(path) as temporary:
        _write(temporary, path, specs, pictures)


def _image(
    path: Path, channels: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any]
) -> tuple[Any, NDArray[np.float32]]:
    shapes = {np.shape(channel) for channel in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise ValueError(f"{path.name}: channels must share one two-dimensional shape, not {sorted(shapes)}")
    height, width = next(iter(shapes))
    pixels = np.stack([np.asarray(channel, np.float32) for channel in channels.values()], axis=-1)
    spec = oiio.ImageSpec(width, height, len(channels), oiio.FLOAT)
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zips")  # 3 x faster to write than zip, 1 % larger (notes 2.4)
    spec.attribute("DateTime", FIXED_TIME)
    spec.attribute("Software", "holocal")
    for key, value in {"schema": SCHEMA, **metadata}.items():
        spec.attribute(f"{PREFIX}{key}", json.dumps(json_ready(value), sort_keys=True))
    return spec, np.ascontiguousarray(pixels)


def _write(temporary: Path, path: Path, specs: Sequence[Any], pictures: Sequence[NDArray[np.float32]]) -> None:
    output = oiio.ImageOutput.create(str(temporary))
    if output is None:
        raise StorageError(f"{path} cannot be written: {one_line(oiio.geterror())}.", fix="Use a name in .exr.")
    good = output.open(str(temporary), specs[0] if len(specs) == 1 else tuple(specs))
    for number, (spec, pixels) in enumerate(zip(specs, pictures, strict=True)):
        good = good and (number == 0 or output.open(str(temporary), spec, "AppendSubimage"))
        good = good and output.write_image(pixels)
    if good and output.close():
        return
    if shutil.disk_usage(path.parent).free < sum(pixels.nbytes for pixels in pictures):  # the library gives no errno
        raise storage_error(OSError(errno.ENOSPC, "disk full"), path)
    raise StorageError(
        f"{path} cannot be written: {one_line(output.geterror() or oiio.geterror())}.",
        why="Nothing was left half written.",
        fix="Check that the directory can be written and has room.",
    )


def read_maps(path: Path) -> Maps:
    """Return the channels of an EXR file by name; `InputError` when it is absent, cut short or damaged."""
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a file.", fix="Check the path.")
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(f"{path} is not an image that can be read: {one_line(oiio.geterror())}.")
    try:
        spec = source.spec()
        if spec.width * spec.height > LARGEST_PIXELS:
            raise InputError(
                f"{path} has {spec.width} x {spec.height} pixels; at most {LARGEST_PIXELS} are read.",
                measured=spec.width * spec.height,
                limit=LARGEST_PIXELS,
            )
        pixels = source.read_image(oiio.FLOAT)
        if pixels is None:
            raise InputError(
                f"{path} is cut short or damaged: {one_line(source.geterror())}.",
                fix="Copy or make the file again; `holocal verify RUN` finds damaged files.",
            )
        names = list(spec.channelnames)
        metadata = {item.name: item.value for item in spec.extra_attribs}
    finally:
        source.close()
    pixels = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, len(names))
    return Maps({name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(names)}, _ours(metadata))


def _ours(metadata: Mapping[str, Any]) -> dict[str, Any]:
    found = {}
    for key, value in metadata.items():
        if key.startswith(PREFIX):
            try:
                found[key.removeprefix(PREFIX)] = json.loads(value)
            except (TypeError, ValueError):
                found[key.removeprefix(PREFIX)] = value
    return found
