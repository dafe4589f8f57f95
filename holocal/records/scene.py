"""A scene image: PNG, JPEG, TIFF or EXR -> intensity (height, width), checked at the border.

The header is looked at before anything is decoded, so an enormous picture costs nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio  # noqa: N813 - its usual name
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.records.files import one_line
from holocal.records.reading import reading

LARGEST_PIXELS = 64_000_000
LUMINANCE = (0.2126, 0.7152, 0.0722)  # ITU-R BT.709
FORMATS = ("bmp", "jpeg", "openexr", "png", "pnm", "tiff")


def read_scene(path: Path, *, srgb: bool = False, allow_black: bool = False) -> NDArray[np.float32]:
    """Return the intensity of a scene image, (height, width) float32, >= 0, row 0 on top.

    Integer images are scaled to 0..1; colour becomes luminance; `srgb` undoes the sRGB transfer curve first (the
    default takes values as intensities). An alpha channel must be opaque everywhere. `allow_black` is for
    images that are part of a scene: a layer may be empty, a scene may not.

    Raises
    ------
    InputError
        The file is absent, empty, damaged, enormous, of another mode, or has values that are no intensities.
    """
    colour = _channels(path, srgb=srgb, allow_black=allow_black)
    if colour.shape[-1] == 1:
        return np.ascontiguousarray(colour[..., 0])
    red, green, blue = (colour[..., i] for i in range(3))
    return np.asarray(LUMINANCE[0] * red + LUMINANCE[1] * green + LUMINANCE[2] * blue, np.float32)


def read_colour(path: Path, *, srgb: bool = False) -> NDArray[np.float32]:
    """Return red, green and blue of a scene image, (height, width, 3) float32; of a grey one, three times the same.

    Checked as by `read_scene`; black is allowed, as a colour without light is.
    """
    colour = _channels(path, srgb=srgb, allow_black=True)
    return np.ascontiguousarray(np.broadcast_to(colour, (*colour.shape[:2], 3)))


def _channels(path: Path, *, srgb: bool, allow_black: bool) -> NDArray[np.float32]:
    """Return a checked image's grey (h, w, 1) or its red, green and blue (h, w, 3)."""
    spec = check_size(path)
    pixels, names = _pixels(path)
    integer = spec.format.basetype not in (oiio.FLOAT, oiio.HALF, oiio.DOUBLE)
    if integer and spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
        raise InputError(
            f"{path} has pixels of type {spec.format}; a scene has 8 or 16 bits or floating point.",
            fix="Save it as an 8- or 16-bit PNG.",
            measured=str(spec.format),
        )
    colour, names = _without_alpha(path, pixels, names)
    if len(names) not in (1, 3):
        raise InputError(
            f"{path} has {len(names)} channels ({', '.join(names)}); a scene is grey or RGB.",
            fix="Save it as a grey or RGB image.",
            measured=len(names),
            limit=[1, 3],
        )
    _check_values(path, colour)
    if not allow_black and not colour.any():
        raise InputError(f"{path} is black everywhere.", why="There is no light to form.", measured=0.0)
    if srgb:
        colour = linear(colour)
    order = [names.index(name) if name in names else i for i, name in enumerate("RGB")] if len(names) == 3 else [0]
    return np.ascontiguousarray(colour[..., order])


def linear(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return sRGB values 0..1 as linear intensity (IEC 61966-2-1)."""
    low = values / 12.92
    high = ((values + 0.055) / 1.055) ** 2.4
    return np.where(values <= 0.04045, low, high).astype(np.float32)


def check_size(path: Path) -> Any:
    """Return the header of an image after checking its existence, format and size; nothing is decoded."""
    with reading(path):
        size = path.stat().st_size
    if path.is_dir():
        raise InputError(f"{path} is a directory; an image file was expected.")
    if size == 0:
        raise InputError(f"{path} is empty: 0 bytes.", fix="Make or copy the file again.", measured=0, limit=1)
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(
            f"{path} is not an image that can be read: {_reason()}.", fix="Use PNG, JPEG, TIFF or OpenEXR."
        )
    try:
        spec, kind = source.spec(), source.format_name()
    finally:
        source.close()
    if kind not in FORMATS:
        raise InputError(f"{path} is a {kind} file.", fix="Use PNG, JPEG, TIFF or OpenEXR.", measured=kind)
    if spec.width < 1 or spec.height < 1:
        raise InputError(f"{path} has {spec.width} x {spec.height} pixels; at least 1 x 1 is needed.")
    if spec.width * spec.height > LARGEST_PIXELS:
        raise InputError(
            f"{path} has {spec.width} x {spec.height} = {spec.width * spec.height / 1e6:.0f} million pixels.",
            why="It would not fit in memory beside the hologram.",
            fix=f"Scale it to at most {LARGEST_PIXELS // 1_000_000} million pixels; 750 x 750 is all a 25 degree "
            "field can show.",
            measured=spec.width * spec.height,
            limit=LARGEST_PIXELS,
        )
    return spec


def _pixels(path: Path) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(f"{path} is not an image that can be read: {_reason()}.")
    try:
        spec, pixels = source.spec(), source.read_image(oiio.FLOAT)
        if pixels is None:
            raise InputError(
                f"{path} is cut short or damaged: {one_line(source.geterror())}.",
                fix="Make or copy the file again.",
            )
    finally:
        source.close()
    shaped = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)
    return shaped, tuple(spec.channelnames)


def _without_alpha(
    path: Path, pixels: NDArray[np.float32], names: tuple[str, ...]
) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    if "A" not in names:
        return pixels, names
    index = names.index("A")
    least = float(pixels[..., index].min())
    if not least >= 1.0 - 1e-3:  # NaN too
        raise InputError(
            f"{path} is transparent in places (alpha down to {least:.3f}).",
            why="What lies behind it is not known.",
            fix="Flatten it on black and save it without alpha.",
            measured=least,
            limit=1.0,
        )
    return np.delete(pixels, index, axis=-1), tuple(name for name in names if name != "A")


def _check_values(path: Path, values: NDArray[np.float32]) -> None:
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise InputError(
            f"{path} has {bad} values that are NaN or infinite.",
            why="An intensity is a finite number.",
            fix="Replace them, by 0 for instance.",
            measured=bad,
            limit=0,
        )
    least = float(values.min())
    if least < 0.0:
        raise InputError(
            f"{path} has values down to {least:.4g}.",
            why="An intensity is not negative.",
            measured=least,
            limit=0.0,
        )


def _reason() -> str:
    return one_line(oiio.geterror() or "the format is not known")
