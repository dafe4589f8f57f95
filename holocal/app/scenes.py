"""Scene files of any kind to clouds of points: images, tables of points, layers, meshes, light fields."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.hologram.scenes.cloud import table_points
from holocal.hologram.scenes.image import InitialPhase, QuadraticPhase, RandomPhase, ZeroPhase, image_cloud
from holocal.hologram.scenes.layers import depth_image_points, layer_points
from holocal.hologram.scenes.light_field import light_field_points
from holocal.hologram.scenes.mesh import mesh_points, placed
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import HologramSettings
from holocal.records.scene import read_colour, read_scene
from holocal.records.scene_data import DepthImage, Layers, LightField, Mesh, ScatteredPoints
from holocal.records.scene_layers import read_layers
from holocal.records.scene_mesh import read_mesh
from holocal.records.scene_points import read_points
from holocal.records.scene_toml import read_tables
from holocal.records.scene_views import read_light_field

Image = NDArray[np.float32]
IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".bmp", ".pgm", ".ppm", ".pnm")
SUFFIXES = (*IMAGES, ".csv", ".obj", ".ply", ".toml")
KINDS = f"images ({', '.join(IMAGES)}), points (.csv), meshes (.obj, .ply), layers and light fields (.toml)"
_NEAREST_M, _PLACED_M = 0.01, 1.0  # a mesh nearer than the first is put at the second
PHASES = ("random", "smooth", "zero")

Content = Image | ScatteredPoints | Mesh | Layers | DepthImage | LightField


@dataclass(frozen=True)
class Scene:
    """What a scene file holds: `kind` in a word, and one content per colour, or one for all."""

    kind: str
    contents: tuple[Content, ...]

    def content(self, colour: int | None) -> Content:
        """Return the content of a colour: 0 red, 1 green, 2 blue; None is all light together."""
        return self.contents[0 if colour is None or len(self.contents) == 1 else colour]


def is_scene(path: Path) -> bool:
    """Return whether a file's name says that it is a scene."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def check_kind(path: Path) -> None:
    """Raise `InputError` for a file whose name says that it is no scene."""
    if path.exists() and path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path} is not a scene that can be read.", fix=f"Scenes are {KINDS}.")


def read(path: Path, *, srgb: bool = False, colour: bool = False) -> Scene:
    """Return what a scene file holds; `colour` keeps an image's red, green and blue apart."""
    check_kind(path)
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return Scene("points", (read_points(path),))
    if suffix in (".obj", ".ply"):
        return Scene("mesh", (read_mesh(path, srgb=srgb),))
    if suffix == ".toml":
        if "view" in read_tables(path):
            return Scene("light field", (read_light_field(path, srgb=srgb),))
        return Scene("layers", (read_layers(path, srgb=srgb),))
    if colour:
        channels = read_colour(path, srgb=srgb)
        return Scene("colour image", tuple(np.ascontiguousarray(channels[..., i]) for i in range(3)))
    return Scene("image", (read_scene(path, srgb=srgb, allow_black=True),))


def clouds(
    content: Content, settings: HologramSettings, *, initial_phase: InitialPhase, pixels: tuple[int, int]
) -> list[PointCloud]:
    """Return a scene's clouds of points for a view: field, depth and colour are the settings'.

    A mesh that lies before the eye as it is, all of z above 0.01 m, is in metres in the pupil's frame (x towards the
    panel, y up, z along the gaze). Any other, and every one with a finite depth in the settings, is moved to that depth
    (1 m), turned to the eye and scaled to fill 0.8 of the field. `pixels` (columns, rows) sample it.
    """
    fov = settings.fov_rad
    if isinstance(content, ScatteredPoints):
        return [table_points(content, initial_phase=initial_phase)]
    if isinstance(content, Layers):
        return layer_points(content, fov_rad=fov, initial_phase=initial_phase)
    if isinstance(content, DepthImage):
        return depth_image_points(content, fov_rad=fov, initial_phase=initial_phase)
    if isinstance(content, LightField):
        return light_field_points(content, fov_rad=fov, initial_phase=initial_phase)
    if isinstance(content, Mesh):
        finite = bool(np.isfinite(settings.depth_m))
        if finite or not np.all(content.vertices_m[:, 2] > _NEAREST_M):
            content = placed(content, distance_m=settings.depth_m if finite else _PLACED_M, fov_rad=fov)
        return [mesh_points(content, fov_rad=fov, pixels=pixels, initial_phase=initial_phase)]
    return [image_cloud(content, fov_rad=fov, depth_m=settings.depth_m, initial_phase=initial_phase)]


def phase_of(name: str, settings: HologramSettings, seed: int) -> InitialPhase:
    """Return the initial phase of a name in `PHASES`."""
    if name == "zero":
        return ZeroPhase()
    if name == "smooth":
        return QuadraticPhase(settings.wavelength_m, settings.fov_rad, settings.bench.pupil_diameter_m)
    return RandomPhase(seed)
