"""A simulated bench that is physics, not the engine turned round.

==========  ===========================================================================
rig         the devices: panel, camera, source; `open_rig` is the plug-in's entry point
aperture    levels on the panel -> field in the pupil of the true, misaligned bench
kernel      the phase between a patch of the panel and the pupil, from the ray trace
pupil       the pupil's grid and transmission
camera      field in the pupil -> power on every pixel, integrated over it
sensor      power -> electrons with their noise -> counts
faults      devices round these that go wrong when the rig's file says so
==========  ===========================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holocal.loop.devices import Rig
    from holocal.records.rig import RigConfig


def open_rig(config: RigConfig) -> Rig:
    """Return the simulated bench of a rig file, open, with the faults that the file asks for."""
    from rigs.simulated.faults import with_faults
    from rigs.simulated.rig import SimulatedRig

    return with_faults(SimulatedRig(_as_plugged_in(config)), config.simulated.faults)


def _as_plugged_in(config: RigConfig) -> RigConfig:
    """Return the file with the exposure that its safety allows, and with the camera that was swapped in."""
    from dataclasses import replace

    tables = config.simulated
    camera, safety, faults = tables.camera, tables.safety, tables.faults
    longest_s = min(camera.max_exposure_s, safety.max_exposure_s or camera.max_exposure_s)
    width, height = faults.swapped_size or (camera.width, camera.height)
    changed = camera.model_copy(update={"max_exposure_s": longest_s, "width": width, "height": height})
    if changed == camera:
        return config
    model = tables.model_copy(update={"camera": changed})
    return replace(config, model=model, tables=model.model_dump(mode="json"))
