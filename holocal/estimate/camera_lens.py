"""Which direction a camera's pixel looks along, and back: its own geometry, apart from the display's.

A rectilinear picture of the camera's field with square pixels; pixel centres are whole numbers, row 0 is on top. The
camera may be turned, and distort radially (`CameraFacts`); both are known from its calibration, by a target or a rig's
file. What is not known of them is taken for the display's: a rotation a moves a point at the radius r by a r, a k1 by
k1 r^3 (0.001 rad: 0.4 pixel at the border of 750 pixels; k1 = 0.01: 0.2 pixel at 25 degrees).
"""

from __future__ import annotations

import numpy as np

from holocal.optics.bench import Array
from holocal.records.facts import CameraFacts

NEWTON_STEPS = 12


def pixel_tan(camera: CameraFacts) -> float:
    """Return a pixel's size in tangents."""
    return float(2 * np.tan(camera.field_rad[0] / 2) / camera.width)


def ideal_pixels(field_tan: Array, camera: CameraFacts) -> Array:
    """Return where a camera of this field, without a geometry of its own, sees tangents: (n, 2) column and row."""
    size = pixel_tan(camera)
    return np.stack(
        [
            field_tan[..., 0] / size + (camera.width - 1) / 2,
            (camera.height - 1) / 2 - field_tan[..., 1] / size,
        ],
        axis=-1,
    )


def ideal_tangents(pixels: Array, camera: CameraFacts) -> Array:
    """Return the tangents that `ideal_pixels` (n, 2) stand for."""
    size = pixel_tan(camera)
    return np.stack(
        [(pixels[..., 0] - (camera.width - 1) / 2) * size, ((camera.height - 1) / 2 - pixels[..., 1]) * size], axis=-1
    )


def seen_pixels(field_tan: Array, camera: CameraFacts) -> Array:
    """Return where the camera sees tangents (n, 2): column and row."""
    square = np.sum(field_tan**2, axis=-1, keepdims=True)
    drawn = field_tan * (1 + camera.k1 * square + camera.k2 * square**2)
    c, s = np.cos(camera.rotation_rad), np.sin(camera.rotation_rad)
    return ideal_pixels(drawn @ np.array([[c, -s], [s, c]]), camera)


def seen_tangents(pixels: Array, camera: CameraFacts) -> Array:
    """Return the tangents (n, 2) that places (n, 2; column, row) in the camera's picture look along."""
    c, s = np.cos(camera.rotation_rad), np.sin(camera.rotation_rad)
    drawn = ideal_tangents(pixels, camera) @ np.array([[c, s], [-s, c]])
    r = np.linalg.norm(drawn, axis=-1, keepdims=True)
    ideal = r.copy()
    for _ in range(NEWTON_STEPS if camera.k1 or camera.k2 else 0):
        square = ideal**2
        value = ideal * (1 + camera.k1 * square + camera.k2 * square**2) - r
        ideal = ideal - value / np.maximum(1 + 3 * camera.k1 * square + 5 * camera.k2 * square**2, 0.1)
    return np.asarray(drawn * np.divide(ideal, r, out=np.ones_like(r), where=r > 0))
