"""Images in planes of their own depths (thesis 1.2, layer-based): nearer ones hide farther ones."""

from __future__ import annotations

import numpy as np

from holocal.errors import InputError
from holocal.hologram.scenes.cloud import Directions
from holocal.hologram.scenes.image import InitialPhase, checked_intensity
from holocal.hologram.scenes.points import PointCloud
from holocal.optics.bench import Array
from holocal.records.scene_data import DepthImage, Layer, Layers


def layer_points(scene: Layers, *, fov_rad: tuple[float, float], initial_phase: InitialPhase) -> list[PointCloud]:
    """Return the points of each depth that are seen from the pupil's centre and have light, nearest depth first.

    Every layer covers `fov_rad`, whatever its size in pixels, and is a plane perpendicular to the gaze at
    z = `depth_m`: a point at tangents t is depth_m sqrt(1 + |t|^2) from the pupil's centre. Where layers overlap, the
    light of the farther one is multiplied by what the nearer ones' masks let through, looked up at the nearest pixel;
    layers of one depth hide nothing of each other. What a pupil of 3 mm sees around an edge is not modelled.

    Parameters
    ----------
    scene
        The layers, in any order.
    fov_rad
        Full angles (x, y) of every layer, centred on the gaze.
    initial_phase
        Of the points. Random phases of two layers are independent, so that a pixel lit in both is two points.
    """
    if not scene.layers:
        raise InputError("The scene has no layers.", measured=0, limit=1)
    clouds: dict[float, list[PointCloud]] = {}
    for index, layer in sorted(enumerate(scene.layers), key=lambda item: item[1].depth_m):
        intensity = checked_intensity(layer.intensity)
        if layer.mask is not None:
            intensity = intensity * layer.mask
        for nearer in scene.layers:
            if nearer.depth_m < layer.depth_m:
                intensity = intensity * (1 - _hiding(nearer, scene.occlusion, intensity.shape))
        directions = Directions.of_image(intensity.shape, fov_rad)
        phase = initial_phase.of_layer(index)(directions.x_tan, directions.y_tan)
        cloud = directions.lit(intensity, depth_m=layer.depth_m, phase_rad=phase)
        if len(cloud):
            clouds.setdefault(layer.depth_m, []).append(cloud)
    return [_joined(parts) for parts in clouds.values()]


def depth_image_points(
    scene: DepthImage, *, fov_rad: tuple[float, float], initial_phase: InitialPhase
) -> list[PointCloud]:
    """Return the points of an image with a depth per pixel in planes evenly spaced in dioptres, nearest plane first.

    The outermost of `scene.layers` planes are at the nearest and the farthest depth that have light, ends included
    (one plane: half way in dioptres), and each pixel goes to the plane nearest in dioptres. Planes without light are
    left out. A pixel is in one plane, so nothing hides anything; the phase is that of the image.
    """
    intensity = checked_intensity(scene.intensity)
    directions = Directions.of_image(intensity.shape, fov_rad)
    phase = initial_phase(directions.x_tan, directions.y_tan)
    dioptres = 1 / np.asarray(scene.depth_m, np.float64)
    lit = intensity > 0
    if not lit.any():
        return []
    planes = _planes(float(dioptres[lit].max()), float(dioptres[lit].min()), scene.layers)
    index = np.searchsorted(-(planes[1:] + planes[:-1]) / 2, -dioptres)
    clouds = [
        directions.lit(np.where(index == i, intensity, 0), depth_m=_depth(plane), phase_rad=phase)
        for i, plane in enumerate(planes)
    ]
    return [cloud for cloud in clouds if len(cloud)]


def _planes(nearest: float, farthest: float, count: int) -> Array:
    """Return the dioptres of the planes, descending."""
    return np.linspace(nearest, farthest, count) if count > 1 else np.array([(nearest + farthest) / 2])


def _depth(dioptres: float) -> float:
    return 1 / dioptres if dioptres > 0 else np.inf


def _hiding(layer: Layer, occlusion: bool | None, shape: tuple[int, ...]) -> Array:
    """Return what share a layer hides of the light behind it, on an image of another shape over the same field."""
    if occlusion is False or (layer.mask is None and not occlusion):
        return np.zeros(shape)
    hides = np.asarray(layer.intensity) > 0 if layer.mask is None else np.asarray(layer.mask)
    rows, columns = (
        (2 * np.arange(count) + 1) * size // (2 * count) for count, size in zip(shape, hides.shape, strict=True)
    )
    return np.asarray(hides[np.ix_(rows, columns)], np.float64)


def _joined(clouds: list[PointCloud]) -> PointCloud:
    if len(clouds) == 1:
        return clouds[0]
    return PointCloud(
        np.concatenate([cloud.field_tan for cloud in clouds]),
        np.concatenate([cloud.distance_m for cloud in clouds]),
        np.concatenate([cloud.amplitude for cloud in clouds]),
        np.concatenate([cloud.phase_rad for cloud in clouds]),
    )
