"""``holocal capture FRAME``: shows a frame on the rig and captures it; the simulated rig propagates it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from holocal.app.cli import options


def capture(
    frame: Annotated[Path, typer.Argument(metavar="FRAME", help="A frame that `holocal render` wrote.")],
    out: Annotated[Path, typer.Option("--out", help="The counts to write, OpenEXR.")] = Path("image.exr"),
    png: Annotated[
        Path | None, typer.Option("--png", help="A picture to look at, too: 8 bits, the brightest thousandth white.")
    ] = None,
    exposure_s: Annotated[
        float | None, typer.Option("--exposure-s", help="Exposure; default: found for 60 % of full scale.")
    ] = None,
    wavelength_nm: options.Wavelength = 515.0,
    rig: options.Rig = options.DEFAULT_RIG,
    seed: options.Seed = 0,
    set_: options.Set = None,
    json: options.Json = False,
    device: options.Device = "cpu",
    debug: options.Debug = False,
) -> None:
    """Show a frame on the rig and capture what the eye would see."""
    import time

    from holocal.app.capturing import capture as captured
    from holocal.app.capturing import capture_metadata, check, write_capture
    from holocal.app.configuration import rig_config
    from holocal.app.session import claimed_rig
    from holocal.app.terminal import Terminal, emit, emit_json
    from holocal.loop.devices import Repeatable
    from holocal.records.frames import read_frame, write_picture
    from holocal.units import NM

    check(out, png, exposure_s, wavelength_nm)
    config = rig_config(rig, set_ or [], device=options.checked_device(device))
    began = time.monotonic()
    with Terminal() as terminal, claimed_rig(config) as bench:
        facts = bench.facts()
        levels = read_frame(frame, width=facts.slm.width, height=facts.slm.height)
        if isinstance(bench, Repeatable):
            bench.begin_step(seed, 0)
        terminal.waiting("the picture")
        taken = captured(bench, levels, wavelength_m=wavelength_nm * NM, exposure_s=exposure_s)
    metadata = capture_metadata(taken, facts.camera, wavelength_m=wavelength_nm * NM)
    write_capture(out, taken, metadata)
    if png is not None:
        write_picture(png, taken.counts)
    if json:
        seconds = time.monotonic() - began
        emit_json({"schema": 1, "image": str(out), "rig": config.name, **metadata, "seconds": seconds})
    else:
        emit(str(out))
