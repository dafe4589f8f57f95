"""A scene file to the files of its hologram: what ``holocal render`` does once its options are read."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from holocal.app import scenes, session
from holocal.app.corrections import Corrections, corrections_of
from holocal.errors import UsageError
from holocal.hologram.encode.direct_search import DirectSearch
from holocal.hologram.encode.double_phase import DoublePhase
from holocal.hologram.encode.encoder import Encoder
from holocal.hologram.encode.error_diffusion import ErrorDiffusion
from holocal.hologram.encode.gradient_descent import GradientDescent
from holocal.hologram.encode.ifta_encoder import Ifta
from holocal.hologram.pipeline import HologramSettings, Rendered
from holocal.hologram.pipeline import render as render_points
from holocal.hologram.settings import Direct, Method, Warped, Zones
from holocal.optics.bench import Bench, Panel
from holocal.records.cache import ArrayCache
from holocal.records.calibration import Accepted
from holocal.records.facts import RigFacts
from holocal.records.files import storage_error
from holocal.records.frames import PACKINGS, write_frame
from holocal.records.maps import write_maps
from holocal.records.rig import RigConfig, identity
from holocal.units import DEGREE, NM

ENCODERS = ("ifta", "gradient-descent", "direct-search", "error-diffusion", "double-phase")
METHODS = ("warped", "zones", "direct")
_GREEN_NM, _BLUE_NM = 580.0, 490.0  # a line above the first shows the image's red, above the second its green


@dataclass(frozen=True)
class Request:
    """A scene and how it is to be seen: angles in degrees, depth in metres, wavelength in nanometres."""

    scene: Path
    fov_deg: tuple[float, float]
    gaze_deg: tuple[float, float]
    depth_m: float
    wavelength_nm: float
    colour: bool
    srgb: bool
    method: str
    accuracy_rad: float
    zones: int | None  # None: as `method` says
    encoder: str
    iterations: int
    initial_phase: str
    pixels: tuple[int, int]
    seed: int
    corrections: str


@dataclass(frozen=True)
class Outputs:
    """The files to write: the frame, and if wanted the phase before quantisation and the full-complex hologram."""

    frame: Path
    packing: str
    phase: Path | None
    hologram: Path | None

    def of_line(self, wavelength_nm: float) -> Outputs:
        """Return the names for one of several wavelengths: ``frame.png`` becomes ``frame-515nm.png``."""

        def named(path: Path | None) -> Path | None:
            return None if path is None else path.with_name(f"{path.stem}-{wavelength_nm:g}nm{path.suffix}")

        return replace(
            self, frame=named(self.frame) or self.frame, phase=named(self.phase), hologram=named(self.hologram)
        )


def check(asked: Request, outputs: Outputs) -> None:
    """Raise `UsageError` for options that cannot be, before anything is computed."""
    limits: list[tuple[str, float, float, float]] = [
        ("--fov-deg", min(asked.fov_deg), 0.01, 120.0),
        ("--fov-deg", max(asked.fov_deg), 0.01, 120.0),
        ("--gaze-deg", max(asked.gaze_deg, key=abs), -60.0, 60.0),
        ("--depth-m", asked.depth_m, 0.01, math.inf),
        ("--wavelength-nm", asked.wavelength_nm, 200.0, 12000.0),
        ("--accuracy", asked.accuracy_rad, 1e-3, 10.0),
    ]
    for name, value, low, high in limits:
        if not low <= value <= high:  # NaN too
            raise UsageError(
                f"{name} {value:g} is not within {low:g} to {high:g}.",
                fix=f"Choose {name} in that range.",
                measured=value,
                limit=[low, high],
            )
    choices = (
        ("--packing", outputs.packing, PACKINGS),
        ("--method", asked.method, METHODS),
        ("--encoder", asked.encoder, ENCODERS),
        ("--initial-phase", asked.initial_phase, scenes.PHASES),
    )
    for option, choice, known in choices:
        if choice not in known:
            raise UsageError(f"{option} {choice} is not known.", fix=f"Choose {', '.join(known)}.")
    if asked.zones is not None and asked.method == "direct":
        raise UsageError(
            "--zones is the thesis's method; it does not go with --method direct.", fix="Drop one of them."
        )
    scenes.check_kind(asked.scene)
    for path, suffix in ((outputs.frame, ".png"), (outputs.phase, ".exr"), (outputs.hologram, ".exr")):
        if path is not None and path.suffix.lower() != suffix:
            raise UsageError(f"{path} does not end in {suffix}.", fix=f"Give it a name that ends in {suffix}.")
        if path is not None and not path.parent.is_dir():
            raise storage_error(FileNotFoundError(2, "no such directory"), path)


def render(config: RigConfig, asked: Request, outputs: Outputs) -> dict[str, Any]:
    """Return the JSON of a rendered scene, after writing its files: one frame, or one for each of the rig's lines."""
    return render_for(known_of(config, asked.corrections), config, asked, outputs)


@dataclass(frozen=True)
class Known:
    """What a rig says of itself, and the corrections in force for it: the same for every scene."""

    facts: RigFacts
    in_force: Mapping[str, Accepted]


def known_of(config: RigConfig, corrections: str) -> Known:
    """Return what is asked of the rig once, before any scene is rendered for it."""
    with session.asked_rig(config) as rig:
        facts = rig.facts()
    return Known(facts, session.corrections(corrections, identity(facts)))


def render_for(known: Known, config: RigConfig, asked: Request, outputs: Outputs) -> dict[str, Any]:
    """Return what `render` returns, for a rig that has been asked already."""
    began = time.monotonic()
    facts, in_force = known.facts, known.in_force
    scene = scenes.read(asked.scene, srgb=asked.srgb, colour=asked.colour)
    read_s = time.monotonic() - began
    fov_rad = (asked.fov_deg[0] * DEGREE, asked.fov_deg[1] * DEGREE)
    corrections = corrections_of(in_force, fov_rad=fov_rad)
    common = {
        "schema": 1,
        "rig": config.name,
        "scene": scene.kind,
        "width": facts.slm.width,
        "height": facts.slm.height,
        "corrections": {name: found.entry for name, found in in_force.items()},
        "seed": asked.seed,
    }
    if not asked.colour:
        said = _line(scene.content(None), asked, asked.wavelength_nm, outputs, facts, config, corrections)
        seconds = {"read": read_s, **said.pop("seconds")}
        return common | said | {"seconds": seconds, "total_seconds": time.monotonic() - began}
    lines = [
        _line(scene.content(_colour_of(nm)), asked, nm, outputs.of_line(nm), facts, config, corrections)
        for nm in sorted((line / NM for line in facts.wavelengths_m), reverse=True)
    ]
    return common | {
        "frames": lines,
        "skipped": [f"{one['wavelength_nm']:g} nm: {said}" for one in lines for said in one["skipped"]],
        "seconds": {"read": read_s, **_summed([one["seconds"] for one in lines])},
        "total_seconds": time.monotonic() - began,
    }


def _line(
    content: scenes.Content,
    asked: Request,
    wavelength_nm: float,
    outputs: Outputs,
    facts: RigFacts,
    config: RigConfig,
    corrections: Corrections,
) -> dict[str, Any]:
    """Render one wavelength and write its files; one without light writes none."""
    settings = _settings(asked, wavelength_nm, facts, config, corrections)
    began = time.monotonic()
    phase = scenes.phase_of(asked.initial_phase, settings, asked.seed)
    points = scenes.clouds(content, settings, initial_phase=phase, pixels=asked.pixels)
    points = [corrections.apply(cloud, settings.gaze_rad) for cloud in points]
    scene_s = time.monotonic() - began
    skipped = corrections.skipped(wavelength_nm)
    if asked.colour and not any(cloud.amplitude.any() for cloud in points):
        skipped.append("the wavelength: no light in it, no frame")
        return {"wavelength_nm": wavelength_nm, "frame": None, "seconds": {"scene": scene_s}, "skipped": skipped}
    rendered = render_points(
        points,
        settings,
        encoder=encoder_of(asked),
        keep_complex=outputs.hologram is not None,
        response_rad=corrections.response_rad(wavelength_nm, facts.slm.bits),
        store=ArrayCache(),
    )
    began_writing = time.monotonic()
    metadata = {"wavelength_nm": wavelength_nm, "pitch_um": facts.slm.pitch_m * 1e6}
    _write(rendered, outputs, metadata=metadata)
    written_s = time.monotonic() - began_writing
    return {
        "wavelength_nm": wavelength_nm,
        "frame": str(outputs.frame),
        "points": sum(len(cloud) for cloud in points),
        "seconds": {"scene": scene_s, **rendered.seconds, "write": written_s},
        "skipped": [*skipped, *rendered.skipped],
        "efficiency": rendered.efficiency,
        "signal_error": list(rendered.signal_error),
    }


def _settings(
    asked: Request, wavelength_nm: float, facts: RigFacts, config: RigConfig, corrections: Corrections
) -> HologramSettings:
    return HologramSettings(
        panel=Panel(facts.slm.width, facts.slm.height, facts.slm.pitch_m),
        bench=corrections.bench(
            Bench.nominal(pupil_diameter_m=facts.pupil_diameter_m, eye_relief_m=facts.eye_relief_m)
        ),
        wavelength_m=wavelength_nm * NM,
        fov_rad=(asked.fov_deg[0] * DEGREE, asked.fov_deg[1] * DEGREE),
        gaze_rad=(asked.gaze_deg[0] * DEGREE, asked.gaze_deg[1] * DEGREE),
        depth_m=asked.depth_m,
        method=method_of(asked),
        iterations=asked.iterations,
        device=config.device,
        wavefront=corrections.wavefront,
    )


def method_of(asked: Request) -> Method:
    """Return the synthesis that the options name."""
    if asked.zones is not None or asked.method == "zones":
        return Zones(asked.zones or Zones().count)
    return Direct() if asked.method == "direct" else Warped(asked.accuracy_rad)


def encoder_of(asked: Request) -> Encoder:
    """Return the encoder that the options name, with as many iterations or passes."""
    count = asked.iterations
    makers: Mapping[str, Encoder] = {
        "ifta": Ifta(count),
        "gradient-descent": GradientDescent(count),
        "direct-search": DirectSearch(count),
        "error-diffusion": ErrorDiffusion(),
        "double-phase": DoublePhase(),
    }
    return makers[asked.encoder]


def _colour_of(wavelength_nm: float) -> int:
    """Return which channel of a colour image a line shows: 0 red, 1 green, 2 blue."""
    return 0 if wavelength_nm >= _GREEN_NM else 1 if wavelength_nm >= _BLUE_NM else 2


def _summed(parts: list[dict[str, float]]) -> dict[str, float]:
    total: dict[str, float] = {}
    for part in parts:
        for stage, spent in part.items():
            total[stage] = total.get(stage, 0.0) + spent
    return total


def _write(rendered: Rendered, outputs: Outputs, *, metadata: dict[str, Any]) -> None:
    write_frame(outputs.frame, rendered.levels, outputs.packing)
    if outputs.phase is not None:
        write_maps(outputs.phase, {"phase": rendered.phase_rad}, units={"phase": "rad"}, metadata=metadata)
    if outputs.hologram is not None:
        field = np.asarray(rendered.field)
        write_maps(outputs.hologram, {"real": field.real, "imag": field.imag}, metadata=metadata)
