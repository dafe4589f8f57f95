"""The simulated bench as a rig: a panel that takes levels, a camera that gives counts, a source."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError, DeviceError
from holocal.loop.devices import Frame, Shown
from holocal.optics.bench import Bench, Panel, Pose
from holocal.records.facts import CameraFacts, RigFacts, SlmFacts
from holocal.records.rig import RigConfig, fingerprint
from holocal.records.rig_model import SimulatedRig as Tables
from holocal.units import DEGREE, MM, NM, UM
from rigs.simulated.aperture import PanelToPupil
from rigs.simulated.camera import Lens, PupilToPicture
from rigs.simulated.pupil import Complex, unit_phase
from rigs.simulated.sensor import Sensor

# Photo-electrons per second and square metre of evenly lit panel: a white field of the 4K panel fills a sixth of the
# well in about 10 ms.
FLUX_E_PER_S_M2 = 1e15
EXPOSURE_MIN_S = 3e-5
LINE_WIDTH_M = 1e-9
PATTERNS_KEPT = 8  # shown again, they cost only the sensor: a pre-flight goes to and fro between two
SMALLEST_DEMAGNIFICATION = 1 / 2.7  # of the panel anywhere in the field: 1 / 2.85 on the nominal bench


def bench_of(tables: Tables) -> Bench:
    """Return the true, misaligned bench of a simulated rig's file."""
    wrong, optics = tables.misalignment, tables.optics

    def pose(rotation_deg: tuple[float, float, float], shift_mm: tuple[float, float, float]) -> Pose:
        turned, moved = (tuple(v * unit for v in values) for values, unit in ((rotation_deg, DEGREE), (shift_mm, MM)))
        return Pose(turned, moved)  # type: ignore[arg-type]

    return Bench(
        pupil_diameter_m=optics.pupil_mm * MM,
        eye_relief_m=optics.eye_relief_mm * MM,
        mirror=pose(wrong.mirror_rotation_deg, wrong.mirror_shift_mm),
        slm=pose(wrong.slm_rotation_deg, wrong.slm_shift_mm),
    )


@dataclass
class Optics:
    """The light's way from the panel to the pixels; built when the first frame of a wavelength is asked for."""

    tables: Tables
    _wavelength_m: float | None = None
    _to_pupil: PanelToPupil | None = None
    _to_picture: PupilToPicture | None = None
    _powers: OrderedDict[tuple[str, float], NDArray[np.float32]] = field(default_factory=OrderedDict)

    @property
    def panel(self) -> Panel:
        """The panel's pixels."""
        slm = self.tables.slm
        return Panel(slm.width, slm.height, slm.pitch_um * UM)

    @cached_property
    def lens(self) -> Lens:
        """The camera's geometry."""
        camera = self.tables.camera
        return Lens(
            camera.width, camera.height, camera.field_deg * DEGREE, camera.rotation_deg * DEGREE, camera.k1, camera.k2
        )

    def illumination(self) -> NDArray[np.float32] | None:
        """Return the amplitude of the light on the panel, (height, width), None where it is 1 everywhere."""
        light = self.tables.illumination
        if light.profile == "flat":
            return None
        waist = light.waist_mm * MM  # of intensity, 1/e^2: the amplitude falls to 1/e there
        x, y = np.exp(-((self.panel.x_m / waist) ** 2)), np.exp(-((self.panel.y_m / waist) ** 2))
        return np.asarray(np.outer(y, x), np.float32)

    def modulation(self, levels: NDArray[np.uint8]) -> Complex:
        """Return what the panel does to the light, (height, width) complex64 of modulus 1."""
        slm = self.tables.slm
        steps = 2**slm.bits
        table = 2 * np.pi * np.arange(steps) / steps if slm.response == "ideal" else np.array(slm.response)
        if slm.crosstalk_um > 0:  # the fringing field blurs the phase itself, fly-back of a wrap included
            sigma = slm.crosstalk_um / slm.pitch_um
            phase = cv2.GaussianBlur(table.astype(np.float32)[levels], (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            return unit_phase(phase.astype(np.float64))
        return unit_phase(table)[levels]

    def power(self, levels: NDArray[np.uint8], sha256: str, wavelength_m: float) -> NDArray[np.float32]:
        """Return the power on every pixel, (height, width), in square metres of evenly lit panel."""
        known = self._powers.get((sha256, wavelength_m))
        if known is None:
            if self._wavelength_m != wavelength_m:
                self._build(wavelength_m)
            assert self._to_pupil is not None
            assert self._to_picture is not None
            known = self._to_picture.power(self._to_pupil.field(self.modulation(levels)))
            self._powers[sha256, wavelength_m] = known
            if len(self._powers) > PATTERNS_KEPT:
                self._powers.popitem(last=False)
        self._powers.move_to_end((sha256, wavelength_m))
        return known

    def _build(self, wavelength_m: float) -> None:
        self._to_pupil = self._to_picture = None  # two wavelengths at once would double the memory
        self._to_pupil = PanelToPupil(
            bench_of(self.tables),
            self.panel,
            wavelength_m,
            illumination=self.illumination(),
            fill_factor=self.tables.slm.fill_factor,
            pupil_edge_m=self.tables.optics.pupil_edge_mm * MM,
        )
        half_x, half_y = self.panel.half_size_m
        reach_m = (SMALLEST_DEMAGNIFICATION * 2 * half_x, SMALLEST_DEMAGNIFICATION * 2 * half_y)
        self._to_picture = PupilToPicture(self._to_pupil.grid, self.lens, wavelength_m, reach_m=reach_m)
        self._wavelength_m = wavelength_m


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
        counts = self._sensor.expose(rate, self._exposure_s, (*what, bench.grabs[what]))
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
        return {
            "misalignment": self._tables.misalignment.model_dump(mode="json"),
            "illumination": self._tables.illumination.model_dump(mode="json"),
            "fill_factor": self._tables.slm.fill_factor,
        }

    def close(self) -> None:
        """Blank the panel, switch the light off, close; safe to call twice."""
        self.slm.blank()
        self.light.off()
        self._bench.is_open = False
