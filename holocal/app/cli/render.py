"""``holocal render SCENE``: scene -> hologram -> the frame that the panel is sent."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="An image: PNG, JPEG, TIFF or OpenEXR.")],
    out: Annotated[Path, typer.Option("--out", help="The frame to write, PNG.")] = Path("frame.png"),
    packing: Annotated[str, typer.Option("--packing", metavar="rgb|mono8", help="How the panel wants it.")] = "rgb",
    phase_out: Annotated[Path | None, typer.Option("--phase-out", help="Phase before quantisation, EXR.")] = None,
    complex_out: Annotated[Path | None, typer.Option("--complex-out", help="Full-complex hologram, EXR.")] = None,
    fov_deg: Annotated[tuple[float, float], typer.Option("--fov-deg", help="Width and height of the scene.")] = (
        25,
        25,
    ),
    gaze_deg: Annotated[tuple[float, float], typer.Option("--gaze-deg", help="Centre of the scene, x and y.")] = (0, 0),
    depth_m: Annotated[float, typer.Option("--depth-m", help="Distance of the scene.")] = math.inf,
    wavelength_nm: options.Wavelength = 515.0,
    srgb: Annotated[bool, typer.Option("--srgb", help="Undo the sRGB curve of the image first.")] = False,
    zones: Annotated[
        int | None,
        typer.Option("--zones", min=1, max=64, help="The thesis's method with so many zones along each side."),
    ] = None,
    iterations: Annotated[int, typer.Option("--iterations", min=0, max=1000, help="IFTA iterations.")] = 10,
    rig: options.Rig = options.DEFAULT_RIG,
    corrections: options.Corrections = "accepted",
    seed: options.Seed = 0,
    set_: options.Set = None,
    json: options.Json = False,
    device: options.Device = "cpu",
    debug: options.Debug = False,
) -> None:
    """Compute the SLM frame of a scene, with the rig's accepted corrections."""
    from holocal.app import rendering
    from holocal.app.configuration import rig_config
    from holocal.app.terminal import Terminal, emit, emit_json

    asked = rendering.Request(
        scene=scene,
        fov_deg=fov_deg,
        gaze_deg=gaze_deg,
        depth_m=depth_m,
        wavelength_nm=wavelength_nm,
        srgb=srgb,
        zones=zones,
        iterations=iterations,
        seed=seed,
        corrections=corrections,
    )
    outputs = rendering.Outputs(frame=out, packing=packing, phase=phase_out, hologram=complex_out)
    rendering.check(asked, outputs)
    config = rig_config(rig, set_ or [], device=options.checked_device(device))
    with Terminal() as terminal:
        terminal.waiting(f"the hologram of {scene.name}")
        said = rendering.render(config, asked, outputs)
        for sentence in said["skipped"][:3]:
            terminal.say(f"skipped: {sentence}", "yellow")
        if len(said["skipped"]) > 3:
            terminal.say(f"skipped: {len(said['skipped']) - 3} more (--json lists them)", "yellow")
        terminal.say(f"{said['total_seconds']:.1f} s, corrections: {', '.join(said['corrections']) or 'none'}")
    if json:
        emit_json(said)
    else:
        emit(str(out))
