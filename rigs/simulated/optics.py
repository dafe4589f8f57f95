"""The light's way from the panel's levels to the power on the camera's pixels, for the bench of a rig's file."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Bench, Panel, Pose
from holocal.records.rig_model import SimulatedRig as Tables
from holocal.units import DEGREE, MM
from rigs.simulated.aperture import PanelToPupil
from rigs.simulated.camera import Lens, PupilToPicture
from rigs.simulated.panel import before_modulation, modulation, pixels_of

PATTERNS_KEPT = 8  # shown again, they cost only the sensor: a pre-flight goes to and fro between two
SMALLEST_DEMAGNIFICATION = 1 / 2.7  # of the panel anywhere in the field: 1 / 2.85 on the nominal bench


def bench_of(tables: Tables) -> Bench:
    """Return the true, misaligned bench of a simulated rig's file; the camera's entrance pupil is its pupil."""
    wrong, optics = tables.misalignment, tables.optics

    def pose(rotation_deg: tuple[float, float, float], shift_mm: tuple[float, float, float]) -> Pose:
        turned, moved = (tuple(v * unit for v in values) for values, unit in ((rotation_deg, DEGREE), (shift_mm, MM)))
        return Pose(turned, moved)  # type: ignore[arg-type]

    return Bench(
        pupil_diameter_m=(tables.camera.pupil_mm or optics.pupil_mm) * MM,
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
        return pixels_of(self.tables.slm)

    @cached_property
    def lens(self) -> Lens:
        """The camera's geometry."""
        camera = self.tables.camera
        return Lens(
            camera.width, camera.height, camera.field_deg * DEGREE, camera.rotation_deg * DEGREE, camera.k1, camera.k2
        )

    def power(self, levels: NDArray[np.uint8], sha256: str, wavelength_m: float) -> NDArray[np.float32]:
        """Return the power on every pixel, (height, width), in square metres of evenly lit panel; read only."""
        known = self._powers.get((sha256, wavelength_m))
        if known is None:
            if self._wavelength_m != wavelength_m:
                self._build(wavelength_m)
            assert self._to_pupil is not None
            assert self._to_picture is not None
            light = modulation(self.tables.slm, levels, wavelength_m)
            known = self._to_picture.power(self._to_pupil.field(light))
            self._powers[sha256, wavelength_m] = known
            if len(self._powers) > PATTERNS_KEPT:
                self._powers.popitem(last=False)
        self._powers.move_to_end((sha256, wavelength_m))
        return known

    def _build(self, wavelength_m: float) -> None:
        self._wavelength_m = self._to_pupil = self._to_picture = None  # two wavelengths at once would double the memory
        slm, camera, optics = self.tables.slm, self.tables.camera, self.tables.optics
        self._to_pupil = PanelToPupil(
            bench_of(self.tables),
            self.panel,
            wavelength_m,
            illumination=before_modulation(slm, self.tables.illumination, wavelength_m),
            fill_factor=slm.fill_factor,
            pupil_edge_m=optics.pupil_edge_mm * MM,
        )
        half_x, half_y = self.panel.half_size_m
        self._to_picture = PupilToPicture(
            self._to_pupil.grid,
            self.lens,
            wavelength_m,
            focus_m=np.inf if camera.focus_m is None else camera.focus_m,
            reach_m=(2 * SMALLEST_DEMAGNIFICATION * half_x, 2 * SMALLEST_DEMAGNIFICATION * half_y),
        )
        self._wavelength_m = wavelength_m
