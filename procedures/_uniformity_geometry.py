"""Image and picture brought to one another by the registration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import RefusedError
from holocal.estimate.registration import Registration

Array = NDArray[np.float64]

# Blobs that are found lie within 0.5 px of a smooth map; forced on a mirrored or turned picture, 7 px and more off it.
RESIDUAL_SHARE = 0.004  # of the picture's width: 3 px of 750
FEWEST_BLOBS = 6


def require_registered(found: Registration) -> Registration:
    """Return the registration if it can be believed.

    Raises
    ------
    RefusedError
        The blobs of the picture are not those of the image.
    """
    limit_px = RESIDUAL_SHARE * found.width
    if found.found >= FEWEST_BLOBS and found.residual_px <= limit_px:
        return found
    raise RefusedError(
        f"The camera's picture does not fit the image: {found.found} of {found.shown} blobs were found, "
        f"{found.residual_px:.1f} px (rms) off a smooth map; the limits are {FEWEST_BLOBS} and {limit_px:.1f} px.",
        why="A brightness map put on the image in the wrong place makes it worse.",
        fix="Check that the camera's picture is neither mirrored nor turned by more than a few degrees, and in focus.",
        measured={"found": found.found, "residual_px": found.residual_px},
        limit={"found": FEWEST_BLOBS, "residual_px": limit_px},
        code="not-registered",
    )


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
