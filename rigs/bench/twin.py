"""What the camera would see: the simulated bench, shown what is on a monitor and lit by the lasers that are on."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from holocal.records.rig import load_rig
from rigs.simulated.rig import SimulatedRig

LOGGER = logging.getLogger("holocal.bench")
US = 1e-6

Screen = Callable[[], NDArray[np.uint8]]


@dataclass
class Twin:
    """The simulated bench of a rig's file, one for every bit depth that a camera asks for.

    `screen` gives the levels that the monitor shows at the moment. The noise of a frame belongs to what was shown, the
    line, the exposure, and the how-manieth such frame it is, as on the simulated rig itself.
    """

    rig: str
    overrides: tuple[str, ...]
    screen: Screen
    _lit_m: set[float] = field(default_factory=set)
    _benches: dict[int, SimulatedRig] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def bench(self, bits: int | None = None) -> SimulatedRig:
        """Return the simulated bench with a sensor of so many bits, of the file's own where None."""
        if bits is None:
            bits = load_rig(self.rig, self.overrides).simulated.camera.bits
        if bits not in self._benches:
            self._benches[bits] = SimulatedRig(load_rig(self.rig, [*self.overrides, f"camera.bits={bits}"]))
        return self._benches[bits]

    def warm_up(self) -> None:
        """Compute the optics of the middle line, which takes seconds, and forget that it was asked for."""
        with self._lock:
            bench = self.bench()
            lines = bench.facts().wavelengths_m
            bench.light.select(lines[len(lines) // 2])
            bench.light.on()
            bench.camera.grab()
            bench.light.off()
            bench.light.select(lines[0])
            bench.begin_step(0, 0)

    def switched(self, wavelength_m: float, on: bool) -> None:
        """Be told that a laser was switched."""
        with self._lock:
            (self._lit_m.add if on else self._lit_m.discard)(wavelength_m)
            LOGGER.info("laser %.0f nm %s", wavelength_m * 1e9, "on" if on else "off")

    def frame(self, exposure_us: int, bits: int) -> NDArray[np.uint16]:
        """Return the counts of a frame that is exposed now."""
        with self._lock:
            bench = self.bench(bits)
            if len(self._lit_m) > 1:
                raise RuntimeError(f"{len(self._lit_m)} lasers are on at once; the bench has one beam")
            bench.slm.show(self.screen())
            for wavelength_m in self._lit_m:
                bench.light.select(wavelength_m)
            (bench.light.on if self._lit_m else bench.light.off)()
            used_us = bench.camera.set_exposure(exposure_us * US) / US
            if round(used_us) != exposure_us:
                raise RuntimeError(f"an exposure of {exposure_us} us is asked for; the bench can do {used_us:g} us")
            frame = bench.camera.grab()
            LOGGER.info("frame of %d us, light %s", exposure_us, sorted(round(line * 1e9) for line in self._lit_m))
            return frame.counts
