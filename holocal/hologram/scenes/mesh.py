"""A mesh seen from the pupil's centre (thesis 1.2, polygon-based): shaded, the hidden removed, a point per pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from holocal.errors import InputError
from holocal.hologram.scenes.cloud import Directions
from holocal.hologram.scenes.image import InitialPhase
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.scenes.raster import NEAREST_M, Seen, seen
from holocal.optics.bench import Array, Vector
from holocal.records.scene_data import Mesh

_MOST_PIXELS = 64_000_000  # as an image


@dataclass(frozen=True)
class Shading:
    """How surfaces are lit: intensity x (ambient + (1 - ambient) x max(0, normal . light)) (Lambert).

    Parameters
    ----------
    light
        Where the light comes from: a direction in P from the scene, of any length. The default is above the eye and to
        the side, behind the viewer (-z).
    ambient
        Share of the light that comes from everywhere, 0 to 1; 1 is no shading at all.
    smooth
        Normals interpolated between vertices, which take the mean of their faces' by area; False: one per face.
    back_faces
        Whether faces are seen from behind; they are then lit as if turned round.
    """

    light: Vector = (-0.4, 0.7, -1.0)
    ambient: float = 0.2
    smooth: bool = False
    back_faces: bool = True

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.light))
        if not (0 < length < np.inf):
            raise InputError(f"The light's direction {self.light} has no direction.", measured=length, limit=0.0)
        if not 0 <= self.ambient <= 1:
            raise InputError(
                f"ambient is {self.ambient:g}; it is a share, 0 to 1.", measured=self.ambient, limit=[0, 1]
            )


def placed(
    mesh: Mesh, *, distance_m: float, fov_rad: tuple[float, float], share: float = 0.8, facing_eye: bool = True
) -> Mesh:
    """Return a mesh with its bounding box's centre on the gaze at z = `distance_m`, as large as `share` of the field.

    It is scaled so that the first of its vertices, in perspective, comes to `share` of half the field in x or y.

    Parameters
    ----------
    distance_m
        Finite, above 0.
    fov_rad
        Full angles (x, y) of the view.
    share
        Above 0; 1 touches the border.
    facing_eye
        True: in the file +z points to the viewer, as in modelling programs; z is turned round, so that the file's front
        is seen, its +x at the picture's right (P's +x). False: z points away from the viewer already, as in P.
    """
    if not (0 < distance_m < np.inf and 0 < share < np.inf):
        raise InputError(f"A mesh cannot fill {share:g} of the field at {distance_m:g} m.", fix="Both are above 0 m.")
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    vertices = (mesh.vertices_m - (low + high) / 2) * (1, 1, -1 if facing_eye else 1)
    allowed = share * np.tan(np.asarray(fov_rad) / 2)
    # |x| scale = allowed (distance + z scale) for the vertex that comes first
    reach = float(((np.abs(vertices[:, :2]) - allowed * vertices[:, 2:]) / allowed).max())
    if not 0 < reach < np.inf:
        raise InputError("The mesh has no extent: all its vertices are at one place.", measured=reach, limit=0.0)
    vertices = vertices * (distance_m / reach) + (0, 0, distance_m)
    if not facing_eye:
        return replace(mesh, vertices_m=vertices)
    return Mesh(vertices, mesh.faces[:, ::-1], mesh.intensity[:, ::-1])  # a mirrored face runs the other way round


def mesh_points(
    mesh: Mesh,
    *,
    fov_rad: tuple[float, float],
    pixels: tuple[int, int] = (750, 750),
    shading: Shading | None = None,
    initial_phase: InitialPhase,
) -> PointCloud:
    """Return a point for each pixel in which the mesh is seen and lit, at the distance of the surface.

    Parameters
    ----------
    mesh
        In P: metres, x towards the panel, y up, z along the gaze. What is nearer than z = 0.01 m is not seen.
    fov_rad
        Full angles (x, y) of the view, rectilinear, centred on the gaze.
    pixels
        Columns and rows of the view; a surface is sampled at the pixels' centres.
    shading
        Default `Shading()`.
    initial_phase
        Of the view's pixels.

    Raises
    ------
    InputError
        No part of the mesh is in view, or none is lit; says where the mesh is.
    """
    shading = shading or Shading()
    columns, rows = pixels
    if not (columns >= 1 and rows >= 1 and columns * rows <= _MOST_PIXELS):
        raise InputError(f"A view of {columns} x {rows} pixels cannot be.", measured=columns * rows, limit=_MOST_PIXELS)
    directions = Directions.of_image((rows, columns), fov_rad)
    corners = mesh.vertices_m[mesh.faces]
    found = seen(corners, directions, back_faces=shading.back_faces)
    if not len(found.triangle):
        raise InputError(
            f"No part of the mesh is in view: {_where(mesh)}; the view is {np.degrees(fov_rad[0]):.4g} x "
            f"{np.degrees(fov_rad[1]):.4g} degrees about +z.",
            fix="Move or scale it, widen the view"
            + ("." if shading.back_faces else ", or show back faces: its faces may be inside out."),
        )
    normals = _normals(mesh, corners, found, smooth=shading.smooth)
    light = np.asarray(shading.light) / np.linalg.norm(shading.light)
    lambert = shading.ambient + (1 - shading.ambient) * np.maximum(normals @ light, 0)
    image, depth = np.zeros((rows, columns)), np.ones((rows, columns))
    image[found.row, found.column] = lambert * np.sum(mesh.intensity[found.triangle] * found.weight, axis=-1)
    depth[found.row, found.column] = found.depth_m
    if not image.any():
        raise InputError(
            "The mesh is in view and dark everywhere.",
            fix="Turn the light, give it an ambient share, or lighter colours.",
        )
    phase = initial_phase(directions.x_tan, directions.y_tan)
    return directions.lit(image, depth_m=depth, phase_rad=phase)


def _normals(mesh: Mesh, corners: Array, found: Seen, *, smooth: bool) -> Array:
    """Return unit normals (n, 3) where the surface is seen, on the side that is seen."""
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # twice the area long
    flat = faces[found.triangle]
    towards_eye = -np.sign(np.sum(flat * corners[found.triangle, 0], axis=-1, keepdims=True))
    normals = _unit(flat)
    if smooth:
        # by place, not by index: files repeat a vertex where its texture has a seam
        _, place = np.unique(mesh.vertices_m, axis=0, return_inverse=True)
        places = place.reshape(-1)[mesh.faces]
        total = np.zeros((places.max() + 1, 3))
        for corner in range(3):
            np.add.at(total, places[:, corner], faces)
        between = np.einsum("nc,ncx->nx", found.weight, _unit(total)[places[found.triangle]])
        normals = np.where(np.linalg.norm(between, axis=-1, keepdims=True) > 0, _unit(between), normals)
    return np.asarray(normals * towards_eye, np.float64)


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1), np.float64)


def _where(mesh: Mesh) -> str:
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    spans = [f"{axis} from {a:.3g} to {b:.3g} m" for axis, a, b in zip("xyz", low, high, strict=True)]
    text = "it spans " + ", ".join(spans)
    in_front = mesh.vertices_m[mesh.vertices_m[:, 2] > NEAREST_M]
    if not len(in_front):
        return f"{text}, behind the eye or nearer than {NEAREST_M} m"
    angles = np.degrees(np.arctan(in_front[:, :2] / in_front[:, 2:]))
    (left, down), (right, up) = angles.min(axis=0), angles.max(axis=0)
    return f"{text}, seen from {left:.1f} to {right:.1f} degrees in x and from {down:.1f} to {up:.1f} in y"
