"""A frame shown on a rig and captured, at an exposure found for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import SafetyStop, UsageError
from holocal.loop.devices import Frame, Rig
from holocal.loop.ending import dark_at_the_end
from holocal.loop.gates import Verdict
from holocal.loop.procedure import Shot
from holocal.loop.shooting import Shooter
from holocal.records.facts import CameraFacts
from holocal.records.files import storage_error
from holocal.records.maps import write_maps
from holocal.units import DEGREE, NM

LEVEL_WANTED = 0.6  # of full scale, for the 99.9th percentile: speckle's tail stays below clipping
LEVEL_GOOD = (0.4, 0.8)
MOST_GRABS = 6
CLIP_LIMIT = 1e-3


def check(out: Path, png: Path | None, exposure_s: float | None, wavelength_nm: float) -> None:
    """Raise `UsageError` for options that cannot be, before any device is touched."""
    for name, value, low, high in (
        ("--exposure-s", exposure_s, 1e-9, 3600.0),
        ("--wavelength-nm", wavelength_nm, 200.0, 12000.0),
    ):
        if value is not None and not low <= value <= high:  # NaN too
            raise UsageError(
                f"{name} {value:g} is not within {low:g} to {high:g}.",
                fix=f"Choose {name} in that range.",
                measured=value,
                limit=[low, high],
            )
    for path, suffix in ((out, ".exr"), (png, ".png")):
        if path is not None and path.suffix.lower() != suffix:
            raise UsageError(f"{path} does not end in {suffix}.", fix=f"Give it a name that ends in {suffix}.")
        if path is not None and not path.parent.is_dir():
            raise storage_error(FileNotFoundError(2, "no such directory"), path)


def capture(rig: Rig, levels: NDArray[np.uint8], *, wavelength_m: float, exposure_s: float | None) -> Frame:
    """Return a frame of `levels`; without an exposure, one whose 99.9th percentile is about 60 % of full scale.

    Raises
    ------
    SafetyStop
        The picture clips at the camera's shortest exposure.
    DeviceError
        A device failed, or gave two unfit frames in a row.
    """
    facts = rig.facts()
    camera = facts.camera
    with dark_at_the_end(rig):
        shooter = Shooter(rig, facts, _ignore)
        if exposure_s is not None:
            return shooter.frame(Shot("capture", levels, exposure_s, wavelength_m, fresh=False))
        wanted_s = float(np.sqrt(camera.exposure_min_s * camera.exposure_max_s))
        for _ in range(MOST_GRABS):
            frame = shooter.frame(Shot("capture", levels, wanted_s, wavelength_m, fresh=False))
            level = float(np.percentile(frame.counts, 99.9)) / camera.full_scale
            if LEVEL_GOOD[0] <= level <= LEVEL_GOOD[1]:
                return frame
            factor = 0.1 if level >= 0.98 else min(30.0, LEVEL_WANTED / max(level, 1e-3))
            next_s = min(max(frame.exposure_s * factor, camera.exposure_min_s), camera.exposure_max_s)
            if np.isclose(next_s, frame.exposure_s, rtol=1e-3):
                break
            wanted_s = next_s
    if frame.saturated_fraction > CLIP_LIMIT:
        raise SafetyStop(
            f"{frame.saturated_fraction:.2%} of the pixels are at full scale at {1e3 * frame.exposure_s:.4g} ms, the "
            f"shortest exposure that was reached; at most {CLIP_LIMIT:.2%} may be.",
            why="Clipped light is not measured, and may harm the sensor.",
            fix="Put a neutral density filter in the beam or lower the laser's power by hand.",
            measured=frame.saturated_fraction,
            limit=CLIP_LIMIT,
            code="too-bright",
        )
    return frame


def capture_metadata(frame: Frame, camera: CameraFacts, *, wavelength_m: float) -> dict[str, Any]:
    """Return what is written beside captured counts: exposure, field of view and pixel scale, JSON-ready."""
    scale_deg = [
        float(np.arctan(2 * np.tan(field / 2) / pixels) / DEGREE)
        for field, pixels in zip(camera.field_rad, (camera.width, camera.height), strict=True)
    ]
    half_x, half_y = (field / 2 / DEGREE for field in camera.field_rad)
    return {
        "exposure_s": frame.exposure_s,
        "field_deg": [field / DEGREE for field in camera.field_rad],
        "pixel_scale_deg": scale_deg,
        "projection": "rectilinear",
        "extent_deg": [-half_x, half_x, -half_y, half_y],
        "full_scale": camera.full_scale,
        "bits": camera.bits,
        "saturated_fraction": frame.saturated_fraction,
        "wavelength_nm": round(wavelength_m / NM, 6),
    }


def write_capture(path: Path, frame: Frame, metadata: dict[str, Any]) -> None:
    """Write a frame's counts as the channel ``counts`` of an EXR file."""
    write_maps(path, {"counts": frame.counts}, units={"counts": "counts"}, metadata=metadata)


def _ignore(_verdict: Verdict, _shot: Shot, _frame: Frame) -> None:
    """A capture has no journal: a bad frame is taken again once, and two end it."""
