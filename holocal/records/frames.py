"""PNG files of frames: what the panel is sent (24-bit, level in red; or mono8), and 16-bit camera counts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813 - its usual name
from numpy.typing import NDArray

from holocal.errors import InputError, StorageError, UsageError
from holocal.records.files import write_bytes
from holocal.records.scene import check_size

PACKINGS = ("rgb", "mono8")
COMPRESSION = 1  # level frames are noise to a compressor: 1 is 4 x faster than 6 and 1 % larger


def packed(levels: NDArray[np.uint8], packing: str = "rgb") -> NDArray[np.uint8]:
    """Return (height, width) levels as the panel is sent them: (height, width, 3) with the level in red, or mono8."""
    if packing == "mono8":
        return levels
    if packing != "rgb":
        raise UsageError(f"packing {packing!r} is not known.", fix=f"Choose one of {', '.join(PACKINGS)}.")
    frame = np.zeros((*levels.shape, 3), np.uint8)
    frame[..., 0] = levels
    return frame


def write_frame(path: Path, levels: NDArray[np.uint8], packing: str = "rgb") -> None:
    """Write levels as the PNG that the panel is sent, whole or not at all."""
    frame = packed(levels, packing)
    write_bytes(path, encode_png(frame if frame.ndim == 2 else frame[..., ::-1]))  # OpenCV's order is blue first


def write_counts(path: Path, counts: NDArray[np.uint16]) -> None:
    """Write camera counts as a 16-bit grey PNG, whole or not at all."""
    write_bytes(path, encode_png(np.asarray(counts, np.uint16)))


def write_picture(path: Path, counts: NDArray[np.uint16]) -> None:
    """Write counts as an 8-bit picture to look at: black at the darkest percent, white at the brightest thousandth."""
    dark, bright = np.quantile(counts, [0.01, 0.999])
    shown = np.clip((counts.astype(np.float32) - dark) * (255 / max(bright - dark, 1)), 0, 255)
    write_bytes(path, encode_png(np.rint(shown).astype(np.uint8)))


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Return the bytes of a PNG; colour in OpenCV's order, blue first."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION])
    if not done:
        raise StorageError(f"an array of shape {pixels.shape} and type {pixels.dtype} cannot be made a PNG.")
    return bytes(data)


def read_counts(path: Path) -> NDArray[np.uint16]:
    """Return the counts of a 16-bit grey PNG."""
    pixels = _decoded(path)
    if pixels.ndim != 2 or pixels.dtype != np.uint16:
        raise InputError(f"{path} is not a 16-bit grey PNG.", measured=f"{pixels.dtype}, shape {pixels.shape}")
    return pixels


def read_frame(path: Path, *, width: int, height: int) -> NDArray[np.uint8]:
    """Return the (height, width) levels of a frame file, 24-bit with the level in red or mono8.

    Raises
    ------
    InputError
        The file is not such an image, is not the panel's size, or has something in green or blue.
    """
    pixels = _decoded(path)
    if pixels.dtype != np.uint8:
        raise InputError(
            f"{path} has {8 * pixels.dtype.itemsize} bits per channel; a frame has 8.",
            fix="Make it with `holocal render`.",
            measured=8 * pixels.dtype.itemsize,
            limit=8,
        )
    if pixels.shape[:2] != (height, width):
        raise InputError(
            f"{path} has {pixels.shape[1]} x {pixels.shape[0]} pixels; the panel has {width} x {height}.",
            why="A frame that is scaled is another hologram.",
            fix="Render it for this rig: `holocal render SCENE --rig ...`.",
            measured=[pixels.shape[1], pixels.shape[0]],
            limit=[width, height],
        )
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] != 3:
        raise InputError(f"{path} has {pixels.shape[2]} channels; a frame has 1 or 3.", measured=pixels.shape[2])
    if pixels[..., 1:].any():
        worst = int(pixels[..., 1:].max())
        raise InputError(
            f"{path} has values up to {worst} in green or blue; a frame has the level in red and 0 there.",
            fix="Make it with `holocal render`.",
            measured=worst,
            limit=0,
        )
    return np.ascontiguousarray(pixels[..., 0])


def _decoded(path: Path) -> NDArray[Any]:
    spec = check_size(path)
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(f"{path} is not an image that can be read.", fix="Make or copy the file again.")
    try:
        pixels = source.read_image(spec.format)
        if pixels is None:
            raise InputError(f"{path} is cut short or damaged.", fix="Make or copy the file again.")
    finally:
        source.close()
    shaped = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    return np.ascontiguousarray(shaped[..., 0] if spec.nchannels == 1 else shaped)
