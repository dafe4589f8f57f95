"""``holocal render SCENE``: scene -> hologram -> the frame that the panel is sent."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def render(
    scene: Annotated[
        list[Path],
        typer.Argument(metavar="SCENE", help="Image, points .csv, mesh .obj .ply, layers or views .toml; or a folder."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The frame to write, PNG (frame.png); of several scenes the directory (frames)."),
    ] = None,
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
    colour: Annotated[
        bool, typer.Option("--colour", help="A frame per wavelength of the rig: --out frame.png gives frame-515nm.png.")
    ] = False,
    srgb: Annotated[bool, typer.Option("--srgb", help="Undo the sRGB curve of the image first.")] = False,
    zones: Annotated[
        int | None,
        typer.Option("--zones", min=1, max=64, help="The thesis's method with so many zones along each side."),
    ] = None,
    method: Annotated[
        str, typer.Option("--method", metavar="warped|zones|direct", help="How the points are summed.")
    ] = "warped",
    accuracy: Annotated[
        float, typer.Option("--accuracy", metavar="RAD", help="Wavefront error that the warped method may leave.")
    ] = 0.1,
    encoder: Annotated[
        str,
        typer.Option(
            "--encoder",
            metavar="ifta|gradient-descent|direct-search|error-diffusion|double-phase",
            help="To phase only.",
        ),
    ] = "ifta",
    iterations: Annotated[
        int, typer.Option("--iterations", min=0, max=1000, help="Iterations of the encoder; it stops when none pays.")
    ] = 10,
    initial_phase: Annotated[
        str, typer.Option("--initial-phase", metavar="random|smooth|zero", help="Of the points.")
    ] = "random",
    pixels: Annotated[
        tuple[int, int], typer.Option("--pixels", min=1, max=8000, help="Columns and rows that sample a mesh.")
    ] = (750, 750),
    rig: options.Rig = options.DEFAULT_RIG,
    corrections: options.Corrections = "accepted",
    workers: options.Workers = 1,
    scheduler: options.Scheduler = None,
    seed: options.Seed = 0,
    set_: options.Set = None,
    json: options.Json = False,
    device: options.Device = "cpu",
    debug: options.Debug = False,
) -> None:
    """Compute the SLM frame of a scene, with the rig's accepted corrections; of a folder, a frame for each scene."""
    from holocal.app import batch, rendering
    from holocal.app.configuration import rig_config
    from holocal.app.farm import farm_of
    from holocal.app.terminal import Terminal, emit, emit_json

    asked = rendering.Request(
        scene=scene[0],
        fov_deg=fov_deg,
        gaze_deg=gaze_deg,
        depth_m=depth_m,
        wavelength_nm=wavelength_nm,
        colour=colour,
        srgb=srgb,
        method=method,
        accuracy_rad=accuracy,
        zones=zones,
        encoder=encoder,
        iterations=iterations,
        initial_phase=initial_phase,
        pixels=pixels,
        seed=seed,
        corrections=corrections,
    )
    several = len(scene) > 1 or scene[0].is_dir()
    path = out or Path("frames" if several else "frame.png")
    outputs = rendering.Outputs(frame=path, packing=packing, phase=phase_out, hologram=complex_out)
    if not several:
        rendering.check(asked, outputs)
    config = rig_config(rig, set_ or [], device=options.checked_device(device))
    farm = farm_of(workers, scheduler)
    if several:
        with Terminal() as terminal:
            every = batch.render_all(config, asked, outputs, scene, farm=farm, said=terminal.counted("scene"))
            terminal.say(f"{len(every['scenes'])} scenes, {every['total_seconds']:.1f} s in {farm}")
        if json:
            emit_json(every)
        else:
            emit(str(path))
        return
    with Terminal() as terminal:
        terminal.waiting(f"the hologram of {scene[0].name}")
        said = rendering.render(config, asked, outputs)
        for sentence in said["skipped"][:3]:
            terminal.say(f"skipped: {sentence}", "yellow")
        if len(said["skipped"]) > 3:
            terminal.say(f"skipped: {len(said['skipped']) - 3} more (--json lists them)", "yellow")
        terminal.say(f"{said['total_seconds']:.1f} s, corrections: {', '.join(said['corrections']) or 'none'}")
    if json:
        emit_json(said)
    else:
        for frame in said["frames"] if colour else [said]:
            if frame["frame"]:
                emit(frame["frame"])
