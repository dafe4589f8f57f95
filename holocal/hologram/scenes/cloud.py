"""Points of a table, and the lit points of a grid, as clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from holocal.hologram.scenes.image import InitialPhase
from holocal.hologram.scenes.points import Aperture, PointCloud
from holocal.optics.bench import Array, image_tangents
from holocal.records.scene_data import ScatteredPoints


def table_points(points: ScatteredPoints, *, initial_phase: InitialPhase) -> PointCloud:
    """Return the points of a table that have light (thesis 1.2, point-cloud-based).

    Angles are rectilinear, each axis by itself: the direction is (tan angle_x, tan angle_y, 1), x towards the panel, y
    up. A point's phase does not depend on which others are dark.
    """
    field_tan = np.tan(points.angle_rad)
    phase = initial_phase.at(field_tan)
    lit = points.intensity != 0
    return PointCloud(field_tan[lit], points.distance_m[lit], np.sqrt(points.intensity[lit]), phase[lit])


@dataclass(frozen=True)
class Directions:
    """Where the pixels of an image look, rectilinear: `x_tan` (w,) ascending and `y_tan` (h,) descending tangents."""

    x_tan: Array
    y_tan: Array

    @classmethod
    def of_image(cls, shape: tuple[int, ...], fov_rad: tuple[float, float]) -> Directions:
        """Return the directions of the pixels of an image (rows, columns) that covers `fov_rad`."""
        return cls(*image_tangents(shape[1], shape[0], fov_rad))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return len(self.y_tan), len(self.x_tan)

    def lit(
        self, intensity: ArrayLike, *, depth_m: ArrayLike, phase_rad: Array, aperture: Aperture | None = None
    ) -> PointCloud:
        """Return a point for each pixel with light, row by row.

        Parameters
        ----------
        intensity, phase_rad
            (h, w) intensities, and radians.
        depth_m
            z of the points, (h, w) or one for all: a point at tangents t is z sqrt(1 + |t|^2) away. (An image at
            `depth_m` of `HologramSettings` lies on a sphere about the pupil instead: one distance for all its points.)
        aperture
            The part of the pupil that they are seen through.
        """
        light = np.asarray(intensity, np.float64)
        rows, columns = np.nonzero(light)
        tangents = np.stack([self.x_tan[columns], self.y_tan[rows]], axis=-1)
        depth = np.broadcast_to(np.asarray(depth_m, np.float64), self.shape)[rows, columns]
        distance = depth * np.sqrt(1 + np.sum(tangents**2, axis=-1))
        return PointCloud(tangents, distance, np.sqrt(light[rows, columns]), phase_rad[rows, columns], aperture)
