"""What the files of scenes hold: plain data, checked when it was read. Row 0 of an image is the top.

Places are in the pupil's frame P: origin at the pupil's centre, x temporal (towards the panel), y up, z along the gaze.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.float32]


@dataclass(frozen=True)
class ScatteredPoints:
    """Luminous points: `angle_rad` (n, 2) from the gaze along x and y, `distance_m` (n,), `intensity` (n,).

    The direction's tangents are (tan(angle x), tan(angle y)); a distance is from the pupil's centre, and infinity is
    one.
    """

    angle_rad: Array
    distance_m: Array
    intensity: Array


@dataclass(frozen=True)
class Layer:
    """An image in the plane z = `depth_m`, which may be infinite.

    `mask` has the image's shape and is 0 to 1: where the layer is. The layer's light is the image times the mask, and
    the mask is what hides the layers behind. None: everywhere, and it hides nothing.
    """

    intensity: Image
    depth_m: float
    mask: Image | None = None


@dataclass(frozen=True)
class Layers:
    """Layers in any order.

    `occlusion` None: masks hide. True: layers without a mask hide too, where they have light. False: nothing hides.
    """

    layers: tuple[Layer, ...]
    occlusion: bool | None = None


@dataclass(frozen=True)
class DepthImage:
    """An image and the depth of each of its pixels (z, not the distance), to be split in `layers` planes."""

    intensity: Image
    depth_m: Array
    layers: int


@dataclass(frozen=True)
class Mesh:
    """Triangles: `vertices_m` (n, 3), `faces` (m, 3) indices, `intensity` (m, 3) of each face's corners.

    Seen from outside, the corners of a face run counterclockwise (in right-handed axes, as P's are).
    """

    vertices_m: Array
    faces: NDArray[np.int64]
    intensity: Array


@dataclass(frozen=True)
class View:
    """What is seen from one part of the pupil, whose centre is `pupil_m` (x, y)."""

    intensity: Image
    pupil_m: tuple[float, float]


@dataclass(frozen=True)
class LightField:
    """Views of a scene from parts of the pupil, all of one shape.

    Parameters
    ----------
    views
        At least one.
    distance_m
        z of the plane that the views' points are put in; may be infinite.
    aperture_m
        Diameter of the part of the pupil that a view is seen through; None is the whole pupil.
    converging
        False: a pixel is a direction, as of a row of parallel cameras, and what is far away has no disparity. True: a
        pixel is a place in the plane at `distance_m`, and what lies there has no disparity.
    """

    views: tuple[View, ...]
    distance_m: float = inf
    aperture_m: float | None = None
    converging: bool = False
