"""Image and picture brought to one another by the registration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.registration import Registration

Array = NDArray[np.float64]


def as_seen(image: NDArray[np.floating[Any]], registration: Registration) -> Array:
    """Return an image (height, width) as the camera sees it, without the bench's brightness."""
    return _moved(image, registration.picture_to_image)


def in_image(picture: NDArray[np.floating[Any]], registration: Registration) -> Array:
    """Return the image (height, width) that the camera would see as a picture."""
    return _moved(picture, registration.image_to_picture)


def _moved(source: NDArray[np.floating[Any]], to_source: Callable[[Array, Array], tuple[Array, Array]]) -> Array:
    import cv2

    height, width = source.shape
    columns, rows = to_source(*np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)))
    at = (columns.astype(np.float32), rows.astype(np.float32))
    moved = cv2.remap(source.astype(np.float32), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float64)


def image_region(registration: Registration) -> NDArray[np.bool_]:
    """Return where the picture (height, width) shows the image and not what lies beyond its border."""
    height, width = registration.height, registration.width
    columns, rows = registration.picture_to_image(
        *np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    )
    margin = 1 + 2 * (registration.residual_px if np.isfinite(registration.residual_px) else 0.0)
    if registration.found == 0:
        margin = 0.0
    inside = (columns >= margin) & (columns <= width - 1 - margin) & (rows >= margin) & (rows <= height - 1 - margin)
    return np.asarray(inside)
