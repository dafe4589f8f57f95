"""Maps of the picture both ways: from where points are sent to where they are seen, and back; and an image through one.

Places are ideal pixels (`camera_lens.ideal_pixels`) of a camera's field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from holocal.errors import InputError
from holocal.estimate.map_basis import apply_homography
from holocal.optics.bench import Array


class PictureMap(Protocol):
    """A map (n, 2) -> (n, 2), its inverse and which places that is sure of, and its error, pixels (n,)."""

    def __call__(self, points: Array) -> Array: ...

    def inverse(self, places: Array) -> tuple[Array, NDArray[np.bool_]]: ...

    def sigma_px(self, points: Array) -> Array: ...


@dataclass(frozen=True)
class FourCorners:
    """The homography of four points: the thesis's correction. What lies between is not known: no error is given."""

    matrix: Array

    @classmethod
    def through(cls, points: Array, places: Array) -> FourCorners:
        """Return the map of four points (4, 2), no three on a line, to four places."""
        found = cv2.getPerspectiveTransform(points.astype(np.float32), places.astype(np.float32))
        return cls(np.asarray(found, np.float64))

    def __call__(self, points: Array) -> Array:
        """Return the places (n, 2)."""
        return np.asarray(apply_homography(self.matrix, points)[0])

    def inverse(self, places: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the points (n, 2), all of them sure."""
        back = np.asarray(np.linalg.inv(self.matrix), np.float64)
        return np.asarray(apply_homography(back, places)[0]), np.ones(len(places), np.bool_)

    def sigma_px(self, points: Array) -> Array:
        """Return NaN: four points leave nothing to judge by."""
        return np.full(len(points), np.nan)


def outermost(points: Array, known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the four of n points that lie farthest towards the corners: (4,) indices."""
    middle = points - points[known].mean(axis=0)
    return np.array(
        [
            int(np.argmax(np.where(known, middle @ np.array(way), -np.inf)))
            for way in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
    )


def predistort(image: ArrayLike, columns: NDArray[np.float32], rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the image whose every pixel (r, c) is what the image has at (`rows`[r, c], `columns`[r, c]); 0 beyond.

    The arrays are where a point sent from a pixel is *seen*, in pixels of the image: what is to be seen there is sent
    from here. One bicubic resampling, cv2.remap; any other tool with these arrays does the same.

    Raises
    ------
    InputError
        The arrays have not the same shape.
    """
    source = np.asarray(image, np.float32)
    if source.ndim != 2 or columns.shape != rows.shape or columns.ndim != 2:
        raise InputError(f"An image {source.shape} and maps {columns.shape}, {rows.shape} do not fit together.")
    made = cv2.remap(source, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
    return np.asarray(np.maximum(made, 0.0), np.float32)


def as_remap(seen_px: Array, shape: tuple[int, int], camera_shape: tuple[int, int]) -> tuple[Any, Any]:
    """Return `predistort`'s arrays for an image of `shape` (rows, columns) from a map over a grid.

    `seen_px` (h, w, 2) is where the points sent from the centres of h x w equal parts of the field are seen, in ideal
    pixels of a camera of `camera_shape` (rows, columns).
    """
    sizes = [n / m for n, m in zip(shape[::-1], camera_shape[::-1], strict=True)]
    columns, rows = (_enlarged((seen_px[..., axis] + 0.5) * sizes[axis] - 0.5, shape) for axis in (0, 1))
    return columns, rows


def _enlarged(values: Array, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return values at the centres of a finer grid, by cubic splines; beyond the outermost centres they go on straight.

    (cv2.remap reads between pixels in steps of 1/32: too coarse for a map.)
    """
    padded = np.pad(values, 2, mode="reflect", reflect_type="odd")
    own = [np.arange(n) for n in padded.shape]
    at = [(np.arange(n) + 0.5) / n * m + 1.5 for n, m in zip(shape, values.shape, strict=True)]
    return np.asarray(RectBivariateSpline(*own, padded)(*at), np.float32)
