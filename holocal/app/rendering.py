"""A scene file to the files of its hologram: what ``holocal render`` does once its options are read."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from holocal.app import session
from holocal.app.corrections import corrected
from holocal.errors import InputError, UsageError
from holocal.hologram.pipeline import HologramSettings, render_image
from holocal.hologram.settings import Warped, Zones
from holocal.optics.bench import Bench, Panel
from holocal.records.files import storage_error
from holocal.records.frames import PACKINGS, write_frame
from holocal.records.maps import write_maps
from holocal.records.rig import RigConfig, identity
from holocal.records.scene import read_scene
from holocal.units import DEGREE, NM

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".bmp", ".pgm", ".ppm", ".pnm")


@dataclass(frozen=True)
class Request:
    """A scene and how it is to be seen: angles in degrees, depth in metres, wavelength in nanometres."""

    scene: Path
    fov_deg: tuple[float, float]
    gaze_deg: tuple[float, float]
    depth_m: float
    wavelength_nm: float
    srgb: bool
    zones: int | None  # None: warped patches
    iterations: int
    seed: int
    corrections: str


@dataclass(frozen=True)
class Outputs:
    """The files to write: the frame, and if wanted the phase before quantisation and the full-complex hologram."""

    frame: Path
    packing: str
    phase: Path | None
    hologram: Path | None


def check(asked: Request, outputs: Outputs) -> None:
    """Raise `UsageError` for options that cannot be, before anything is computed."""
    limits: list[tuple[str, float, float, float]] = [
        ("--fov-deg", min(asked.fov_deg), 0.01, 120.0),
        ("--fov-deg", max(asked.fov_deg), 0.01, 120.0),
        ("--gaze-deg", max(asked.gaze_deg, key=abs), -60.0, 60.0),
        ("--depth-m", asked.depth_m, 0.01, math.inf),
        ("--wavelength-nm", asked.wavelength_nm, 200.0, 12000.0),
    ]
    for name, value, low, high in limits:
        if not low <= value <= high:  # NaN too
            raise UsageError(
                f"{name} {value:g} is not within {low:g} to {high:g}.",
                fix=f"Choose {name} in that range.",
                measured=value,
                limit=[low, high],
            )
    if outputs.packing not in PACKINGS:
        raise UsageError(f"--packing {outputs.packing} is not known.", fix=f"Choose {' or '.join(PACKINGS)}.")
    if asked.scene.exists() and asked.scene.suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(
            f"{asked.scene} is not an image.", fix=f"Scenes are images for now: {', '.join(IMAGE_SUFFIXES)}."
        )
    for path, suffix in ((outputs.frame, ".png"), (outputs.phase, ".exr"), (outputs.hologram, ".exr")):
        if path is not None and path.suffix.lower() != suffix:
            raise UsageError(f"{path} does not end in {suffix}.", fix=f"Give it a name that ends in {suffix}.")
        if path is not None and not path.parent.is_dir():
            raise storage_error(FileNotFoundError(2, "no such directory"), path)


def render(config: RigConfig, asked: Request, outputs: Outputs) -> dict[str, Any]:
    """Return the JSON of a rendered scene, after writing its files."""
    began = time.monotonic()
    scene = read_scene(asked.scene, srgb=asked.srgb)
    read_s = time.monotonic() - began
    with session.opened_rig(config) as rig:
        facts = rig.facts()
    in_force = session.corrections(asked.corrections, identity(facts))
    fov_rad = (asked.fov_deg[0] * DEGREE, asked.fov_deg[1] * DEGREE)
    gaze_rad = (asked.gaze_deg[0] * DEGREE, asked.gaze_deg[1] * DEGREE)
    settings = HologramSettings(
        panel=Panel(facts.slm.width, facts.slm.height, facts.slm.pitch_m),
        bench=Bench.nominal(pupil_diameter_m=facts.pupil_diameter_m, eye_relief_m=facts.eye_relief_m),
        wavelength_m=asked.wavelength_nm * NM,
        fov_rad=fov_rad,
        gaze_rad=gaze_rad,
        depth_m=asked.depth_m,
        method=Warped() if asked.zones is None else Zones(asked.zones),
        iterations=asked.iterations,
        device=config.device,
    )
    intensity = corrected(scene, in_force, fov_rad=fov_rad, gaze_rad=gaze_rad)
    rendered = render_image(intensity, settings, seed=asked.seed, keep_complex=outputs.hologram is not None)
    began_writing = time.monotonic()
    _write(rendered, outputs, metadata={"wavelength_nm": asked.wavelength_nm, "pitch_um": facts.slm.pitch_m * 1e6})
    written_s = time.monotonic() - began_writing
    return {
        "schema": 1,
        "frame": str(outputs.frame),
        "rig": config.name,
        "width": facts.slm.width,
        "height": facts.slm.height,
        "seconds": {"read": read_s, **rendered.seconds, "write": written_s},
        "total_seconds": time.monotonic() - began,
        "skipped": list(rendered.skipped),
        "efficiency": rendered.efficiency,
        "corrections": {name: found.entry for name, found in in_force.items()},
        "seed": asked.seed,
    }


def _write(rendered: Any, outputs: Outputs, *, metadata: dict[str, Any]) -> None:
    write_frame(outputs.frame, rendered.levels, outputs.packing)
    if outputs.phase is not None:
        write_maps(outputs.phase, {"phase": rendered.phase_rad}, units={"phase": "rad"}, metadata=metadata)
    if outputs.hologram is not None:
        field = np.asarray(rendered.field)
        write_maps(outputs.hologram, {"real": field.real, "imag": field.imag}, metadata=metadata)
