"""Views from parts of the pupil (thesis 1.2, light-ray-field-based): a cloud for each, limited to its part.

A view's pixel is a bundle of rays through the part of the pupil about q. It becomes a point in the plane z = D that all
views share, and the point is lit through that part alone. D = infinity makes each pixel a plane wave.

Parallel views (the default) are pinhole cameras at q that look along the gaze: a pixel at tangents t is the ray from q
in the direction (t, 1). A scene's point P = (X, Y, Z) is at t = ((X, Y) - q) / Z. The pixel's point is

    p = (q + D t, D),    tangents from the pupil's centre q / D + t,    distance D sqrt(1 + |q / D + t|^2),

for a scene's point at Z = D that is P itself in every view. Converging views are sheared so that the plane z = D has no
disparity: the pixel is the ray from q through D (t, 1), which is its point; P is at t = q / D + ((X, Y) - q) / Z.

What lies at another depth Z than D is a different point of the plane in each view. Where the eye accommodates to Z the
views lie on each other; each is as sharp as its part of the pupil allows: wavelength / diameter by diffraction, and
diameter |1 / Z - 1 / D| out of focus.

**Phases.** Coherent light of one point has one phase, so points that views share must have it in all of them: the phase
belongs to a place in the plane, not to a view. Converging views, and parallel ones at infinity, have the same points,
hence phase by pixel; they add up to points seen through the whole pupil, with its resolution. Parallel views at a
finite D are displaced by q / D against each other; their pixels take the phase of the nearest pixel of the central
view, so they agree to within half a pixel, exactly where q / D is a whole number of pixels. Content off the plane has
unrelated phases in each view: there, views add up like separate sources with speckle, and no phase would make them one
point.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from holocal.errors import InputError
from holocal.hologram.scenes.cloud import Directions
from holocal.hologram.scenes.image import InitialPhase, checked_intensity
from holocal.hologram.scenes.points import Aperture, PointCloud
from holocal.optics.bench import Array
from holocal.records.scene_data import LightField


def light_field_points(
    scene: LightField, *, fov_rad: tuple[float, float], initial_phase: InitialPhase
) -> list[PointCloud]:
    """Return a cloud per view that has light, in the views' order, each with its aperture.

    Parameters
    ----------
    scene
        Views of one shape. With `aperture_m` None every view is seen through the whole pupil.
    fov_rad
        Full angles (x, y) of every view.
    initial_phase
        Of the places in the plane at `scene.distance_m`; see above.
    """
    images = [checked_intensity(view.intensity) for view in scene.views]
    if len({image.shape for image in images}) != 1:
        raise InputError(
            f"The views have the shapes {[image.shape for image in images]}; they must be one.",
            fix="Give at least one view, all of one size.",
        )
    directions = Directions.of_image(images[0].shape, fov_rad)
    shifts = np.zeros((len(images), 2))
    if not scene.converging and np.isfinite(scene.distance_m):
        shifts = np.array([view.pupil_m for view in scene.views]) / scene.distance_m
    phases = _shared_phases(directions, shifts, initial_phase)
    clouds = []
    for view, image, shift, phase in zip(scene.views, images, shifts, phases, strict=True):
        aperture = None if scene.aperture_m is None else Aperture(view.pupil_m, scene.aperture_m)
        seen = replace(directions, x_tan=directions.x_tan + shift[0], y_tan=directions.y_tan + shift[1])
        cloud = seen.lit(image, depth_m=scene.distance_m, phase_rad=phase, aperture=aperture)
        if len(cloud):
            clouds.append(cloud)
    return clouds


def _shared_phases(directions: Directions, shifts: Array, initial_phase: InitialPhase) -> list[Array]:
    """Return each view's phases (h, w), cut out of one grid over the plane; `shifts` (n, 2) are tangents."""
    rows, columns = directions.shape
    pitch = np.array([_pitch(directions.x_tan), -_pitch(-directions.y_tan)])  # a row further down is a smaller y
    steps = np.rint(shifts / pitch).astype(int)  # columns, rows
    most = np.abs(steps).max(axis=0)
    if most[0] > columns or most[1] > rows:
        raise InputError(
            f"Views are displaced by up to {most.max()} pixels in their plane; they have {columns} x {rows}.",
            fix="Put the plane farther away: distance_m.",
            measured=int(most.max()),
            limit=min(rows, columns),
        )
    x_tan = _extended(directions.x_tan, pitch[0], int(most[0]))
    y_tan = _extended(directions.y_tan, pitch[1], int(most[1]))
    plane = initial_phase(x_tan, y_tan)
    return [
        plane[most[1] + down : most[1] + down + rows, most[0] + right : most[0] + right + columns]
        for right, down in steps
    ]


def _pitch(ascending: Array) -> float:
    return float(ascending[1] - ascending[0]) if len(ascending) > 1 else float(np.inf)


def _extended(tangents: Array, pitch: float, count: int) -> Array:
    before = tangents[0] - pitch * np.arange(count, 0, -1) if count else tangents[:0]
    after = tangents[-1] + pitch * np.arange(1, count + 1) if count else tangents[:0]
    return np.concatenate([before, tangents, after])
