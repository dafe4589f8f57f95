"""A simulated bench that is physics, not the engine turned round.

==========  ===========================================================================
rig         the devices: panel, camera, source; `open_rig` is the plug-in's entry point
aperture    levels on the panel -> field in the pupil of the true, misaligned bench
kernel      the phase between a patch of the panel and the pupil, from the ray trace
pupil       the pupil's grid and transmission
camera      field in the pupil -> power on every pixel, integrated over it
sensor      power -> electrons with their noise -> counts
==========  ===========================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holocal.records.rig import RigConfig
    from rigs.simulated.rig import SimulatedRig


def open_rig(config: RigConfig) -> SimulatedRig:
    """Return the simulated bench of a rig file, open."""
    from rigs.simulated.rig import SimulatedRig

    return SimulatedRig(config)
