"""The simulated bench as a rig: a panel that takes levels, a camera that gives counts, a source."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError, DeviceError
from holocal.loop.devices import Frame, Shown
from holocal.records.facts import CameraFacts, RigFacts, SlmFacts
from holocal.records.rig import RigConfig, fingerprint
from holocal.units import MM, NM, UM
from rigs.simulated.optics import Optics
from rigs.simulated.panel import phase_of_levels
from rigs.simulated.sensor import Sensor, stream

# Photo-electrons per second and square metre of evenly lit panel: a white field of the 4K panel fills a sixth of the
# well in about 10 ms.
FLUX_E_PER_S_M2 = 1e15
EXPOSURE_MIN_S = 3e-5
LINE_WIDTH_M = 1e-9
FLICKER = 0xF11C  # the laser's own stream of random numbers; the sensor's are those of its bands


@dataclass
class _Bench:
    """What is on the bench now; the devices share it."""

    optics: Optics
    levels: NDArray[np.uint8]
    sha256: str
    wavelength_m: float
    light_on: bool = False
    is_open: bool = True
    step: tuple[int, int] = (0, 0)  # the run's seed and step, see begin_step
    grabs: dict[tuple[object, ...], int] = field(default_factory=dict)

    def flicker(self, key: tuple[object, ...]) -> np.float32:
        """Return the laser's power in a frame, of its mean."""
        tables = self.optics.tables
        rms = tables.illumination.power_noise
        return np.float32(max(0.0, 1 + rms * stream(tables.seed, key, FLICKER).standard_normal()) if rms else 1.0)

    def require_open(self) -> None:
        if not self.is_open:
            raise DeviceError("The simulated rig is closed.", fix="Open it again.")


@dataclass
class SimulatedSlm:
    """The simulated panel."""

    _bench: _Bench
    _facts: SlmFacts

    def describe(self) -> SlmFacts:
        """Return the panel's facts."""
        return self._facts

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        """Show (height, width) levels."""
        self._bench.require_open()
        shape = (self._facts.height, self._facts.width)
        if levels.dtype != np.uint8 or levels.shape != shape:
            raise DeviceError(
                f"The panel takes {shape[1]} x {shape[0]} levels of 8 bits; it was given {levels.dtype} of shape "
                f"{levels.shape}.",
                fix="Render the frame for this rig.",
            )
        if levels.max(initial=0) >= 2**self._facts.bits:
            raise DeviceError(
                f"Level {levels.max()} was sent to a panel of {self._facts.bits} bits.",
                limit=2**self._facts.bits - 1,
                measured=int(levels.max()),
            )
        self._bench.levels = np.ascontiguousarray(levels).copy()
        self._bench.sha256 = hashlib.sha256(self._bench.levels.data).hexdigest()
        return Shown(self._bench.sha256, read_back_ok=True)

    def blank(self) -> None:
        """Show level 0 everywhere."""
        if self._bench.is_open:
            self.show(np.zeros((self._facts.height, self._facts.width), np.uint8))


@dataclass
class SimulatedCamera:
    """The simulated camera."""

    _bench: _Bench
    _facts: CameraFacts
    _sensor: Sensor
    _exposure_s: float = 0.01
    _frame_id: int = 0

    def describe(self) -> CameraFacts:
        """Return the camera's facts."""
        return self._facts

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure, in whole microseconds within the camera's bounds, and return it."""
        self._bench.require_open()
        low, high = self._facts.exposure_min_s, self._facts.exposure_max_s
        if not np.isfinite(exposure_s) or exposure_s <= 0:
            raise ConfigError(f"An exposure of {exposure_s} s was asked for.", fix=f"Ask for {low:g} to {high:g} s.")
        self._exposure_s = float(np.clip(round(exposure_s * 1e6) * 1e-6, low, high))
        return self._exposure_s

    def grab(self) -> Frame:
        """Take one frame of what the panel shows now."""
        bench = self._bench
        bench.require_open()
        if bench.light_on:
            rate = bench.optics.power(bench.levels, bench.sha256, bench.wavelength_m) * np.float32(FLUX_E_PER_S_M2)
        else:
            rate = np.zeros((self._facts.height, self._facts.width), np.float32)
        # Without light it does not matter what is on the panel: a run that is resumed has another pattern there.
        seen = (bench.sha256, bench.wavelength_m) if bench.light_on else ()
        what = (*bench.step, *seen, bench.light_on, self._exposure_s)
        bench.grabs[what] = bench.grabs.get(what, 0) + 1
        key = (*what, bench.grabs[what])
        counts = self._sensor.expose(rate * bench.flicker(key), self._exposure_s, key)
        self._frame_id += 1
        saturated = float(np.mean(counts >= self._facts.full_scale))
        return Frame(counts, self._exposure_s, self._frame_id, saturated)


@dataclass
class SimulatedLight:
    """The simulated source: one line at a time, of a power that nothing changes."""

    _bench: _Bench
    _wavelengths_m: tuple[float, ...]

    def select(self, wavelength_m: float) -> None:
        """Choose the line nearest to a wavelength."""
        nearest = min(self._wavelengths_m, key=lambda line: abs(line - wavelength_m))
        if abs(nearest - wavelength_m) > LINE_WIDTH_M:
            lines = ", ".join(f"{line / NM:g}" for line in self._wavelengths_m)
            raise ConfigError(
                f"The rig has no laser line at {wavelength_m / NM:g} nm.", fix=f"Choose one of {lines} nm.", limit=lines
            )
        self._bench.wavelength_m = nearest

    def on(self) -> None:
        """Switch the light on."""
        self._bench.require_open()
        self._bench.light_on = True

    def off(self) -> None:
        """Switch the light off."""
        self._bench.light_on = False


class SimulatedRig:
    """The simulated bench: `slm`, `camera`, `light`, opened and closed together."""

    def __init__(self, config: RigConfig) -> None:
        tables = config.simulated
        slm, camera, optics = tables.slm, tables.camera, tables.optics
        lens = Optics(tables).lens
        height_rad = 2 * float(np.arctan(np.tan(lens.field_rad / 2) * camera.height / camera.width))
        sensor = Sensor(
            camera.width,
            camera.height,
            camera.bits,
            camera.full_well_e,
            camera.read_noise_e,
            camera.dark_e_per_s,
            camera.shot_noise,
            camera.hot_pixels,
            camera.psf_px,
            tables.seed,
        )
        slm_facts = SlmFacts(slm.width, slm.height, slm.pitch_um * UM, slm.bits, "holocal", "simulated panel", "S0")
        camera_facts = CameraFacts(
            camera.width,
            camera.height,
            (lens.field_rad, height_rad),
            sensor.full_scale,
            min(EXPOSURE_MIN_S, camera.max_exposure_s),
            camera.max_exposure_s,
            camera.bits,
            "holocal",
            "simulated camera",
            "C0",
            lens.rotation_rad,
            lens.k1,
            lens.k2,
        )
        wavelengths = tuple(line * NM for line in optics.wavelengths_nm)
        self._tables = tables
        self._facts = RigFacts(
            name=config.name,
            slm=slm_facts,
            camera=camera_facts,
            wavelengths_m=wavelengths,
            pupil_diameter_m=optics.pupil_mm * MM,
            eye_relief_m=optics.eye_relief_mm * MM,
            simulated=True,
            fingerprint=fingerprint(config),
        )
        blank = np.zeros((slm.height, slm.width), np.uint8)
        self._bench = _Bench(Optics(tables), blank, hashlib.sha256(blank.data).hexdigest(), wavelengths[0])
        self.slm = SimulatedSlm(self._bench, slm_facts)
        self.camera = SimulatedCamera(self._bench, camera_facts, sensor)
        self.light = SimulatedLight(self._bench, wavelengths)

    def facts(self) -> RigFacts:
        """Return what the rig says of itself; nothing of its misalignment."""
        return self._facts

    def begin_step(self, seed: int, step: int) -> None:
        """Start the noise of a run's step anew, so that a resumed run sees what an unbroken one would have seen."""
        self._bench.step = (seed, step)
        self._bench.grabs.clear()

    def truth(self) -> dict[str, Any]:
        """Return what only a simulated rig can know."""
        slm, camera = self._tables.slm, self._tables.camera
        return {
            "misalignment": self._tables.misalignment.model_dump(mode="json"),
            "illumination": self._tables.illumination.model_dump(mode="json"),
            "fill_factor": slm.fill_factor,
            "response_rad": {  # of every level, by line in nm
                f"{line:g}": phase_of_levels(slm, line * NM).tolist() for line in self._tables.optics.wavelengths_nm
            },
            "slm": slm.model_dump(mode="json", include={"crosstalk_um", "flatness_nm"}),
            "camera": camera.model_dump(mode="json", include={"rotation_deg", "k1", "k2", "focus_m", "pupil_mm"}),
        }

    def close(self) -> None:
        """Blank the panel, switch the light off, close; safe to call twice."""
        self.slm.blank()
        self.light.off()
        self._bench.is_open = False
