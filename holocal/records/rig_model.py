"""The simulated rig's file as a typed model: every value has a range, every unknown key is refused.

The defaults are the thesis's bench (physics.md section 2) with nothing wrong with it.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from holocal.records.fault_model import FaultTable
from holocal.records.safety import SafetyTable

Pixels = Annotated[int, Field(ge=1, le=16384)]
WavelengthNm = Annotated[float, Field(ge=200.0, le=12000.0)]
AngleDeg = Annotated[float, Field(ge=-45.0, le=45.0)]
ShiftMm = Annotated[float, Field(ge=-50.0, le=50.0)]
Level = Annotated[float, Field(ge=-100.0, le=100.0)]
Noll = Annotated[int, Field(ge=1, le=231)]  # to order 20
PathNm = Annotated[float, Field(ge=-1e5, le=1e5)]

NO_ROTATION = (0.0, 0.0, 0.0)


class Table(BaseModel):
    """A TOML table: typed strictly, unknown keys refused, numbers finite, never changed afterwards."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class SlmTable(Table):
    """``[slm]``: the panel. `response` is "ideal" (2 pi L / 2**bits) or the phase of each level in radians.

    A table holds at `response_nm`, and at other lines by the same path difference (the liquid crystal's dispersion is
    neglected); left out, it holds at every line, as on a panel with a look-up table per colour.

    `fill_factor` is the share of a pixel's area that is modulated: it gives the sinc envelope of the pixels and, below
    1, the unmodulated light of the frames between them. Left out, pixels are points: neither is there.

    `flatness_nm` is the panel's shape as optical path (twice the height of a mirror), a list of [Noll index, rms in nm]
    over the circle round the panel; positive is a delay.
    """

    width: Pixels = 3840
    height: Pixels = 2160
    pitch_um: float = Field(default=3.74, gt=0.0, le=1000.0)
    bits: int = Field(default=8, ge=1, le=8)
    response: Literal["ideal"] | tuple[Level, ...] = "ideal"
    response_nm: WavelengthNm | None = None
    fill_factor: float | None = Field(default=None, gt=0.0, le=1.0)
    crosstalk_um: float = Field(default=0.0, ge=0.0, le=100.0)
    flatness_nm: tuple[tuple[Noll, PathNm], ...] = Field(default=(), max_length=231)
    serial: str | None = None  # of the panel that must be there; None: any

    @model_validator(mode="after")
    def _table_has_one_phase_per_level(self) -> SlmTable:
        if self.response != "ideal" and len(self.response) != 2**self.bits:
            raise ValueError(
                f"response has {len(self.response)} entries; {self.bits} bits need {2**self.bits}, one per level"
            )
        return self

    @model_validator(mode="after")
    def _flatness_names_each_polynomial_once(self) -> SlmTable:
        names = [noll for noll, _ in self.flatness_nm]
        twice = sorted({noll for noll in names if names.count(noll) > 1})
        if twice:
            raise ValueError(f"flatness_nm gives Noll index {twice[0]} twice")
        return self


class OpticsTable(Table):
    """``[optics]``: the laser lines and the eye's pupil.

    The pupil's transmission falls from 1 to 0 over `pupil_edge_mm`, half way at its nominal rim; 0 is a knife edge.
    """

    wavelengths_nm: tuple[WavelengthNm, ...] = Field(default=(473.0, 515.0, 639.0), min_length=1, max_length=16)
    pupil_mm: float = Field(default=3.0, gt=0.0, le=20.0)
    eye_relief_mm: float = Field(default=12.0, gt=0.0, le=100.0)
    pupil_edge_mm: float = Field(default=0.2, ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _pupil_is_wider_than_its_edge(self) -> OpticsTable:
        if self.pupil_edge_mm >= self.pupil_mm:
            raise ValueError(f"pupil_edge_mm = {self.pupil_edge_mm:g} is not below pupil_mm = {self.pupil_mm:g}")
        return self


class MisalignmentTable(Table):
    """``[misalignment]``: what is wrong with the bench, each [x, y, z]; the calibration is not told."""

    mirror_rotation_deg: tuple[AngleDeg, AngleDeg, AngleDeg] = NO_ROTATION
    mirror_shift_mm: tuple[ShiftMm, ShiftMm, ShiftMm] = NO_ROTATION
    slm_rotation_deg: tuple[AngleDeg, AngleDeg, AngleDeg] = NO_ROTATION
    slm_shift_mm: tuple[ShiftMm, ShiftMm, ShiftMm] = NO_ROTATION


class CameraTable(Table):
    """``[camera]``: the sensor and its lens; `field_deg` is the full width, the height follows from square pixels.

    `focus_m` is the distance that it is focused at, left out (or inf): infinity. `pupil_mm` is its entrance pupil,
    which takes the place of the eye's; left out, it is as wide as the eye's.
    """

    width: Pixels = 750
    height: Pixels = 750
    field_deg: float = Field(default=25.0, gt=0.0, le=120.0)
    rotation_deg: float = Field(default=0.0, ge=-180.0, le=180.0)
    k1: float = Field(default=0.0, ge=-10.0, le=10.0)
    k2: float = Field(default=0.0, ge=-100.0, le=100.0)
    focus_m: float | None = Field(default=None, ge=0.05)
    pupil_mm: float | None = Field(default=None, gt=0.0, le=20.0)
    bits: int = Field(default=12, ge=1, le=16)
    full_well_e: float = Field(default=10000.0, gt=0.0, le=1e9)
    read_noise_e: float = Field(default=6.0, ge=0.0, le=1e6)
    dark_e_per_s: float = Field(default=5.0, ge=0.0, le=1e9)
    shot_noise: bool = True
    hot_pixels: int = Field(default=0, ge=0, le=1_000_000)
    psf_px: float = Field(default=0.0, ge=0.0, le=100.0)
    max_exposure_s: float = Field(default=1.0, gt=0.0, le=3600.0)
    serial: str | None = None  # of the camera that must be there; None: any

    @field_validator("focus_m", mode="before")
    @classmethod
    def _infinity_is_a_distance(cls, value: object) -> object:
        return None if isinstance(value, float) and value == math.inf else value


class IlluminationTable(Table):
    """``[illumination]``: the beam on the panel; `waist_mm` is the 1/e^2 radius of intensity of the Gaussian.

    `power_noise` is how much the laser flickers from frame to frame, relative, rms.
    """

    profile: Literal["flat", "gaussian"] = "flat"
    waist_mm: float = Field(default=9.0, gt=0.0, le=1000.0)
    power_noise: float = Field(default=0.0, ge=0.0, le=0.3)


class SimulatedRig(Table):
    """A simulated rig's whole file (contract section 6)."""

    kind: Literal["simulated"] = "simulated"
    seed: int = Field(default=0, ge=0, lt=2**63)
    slm: SlmTable = SlmTable()
    optics: OpticsTable = OpticsTable()
    misalignment: MisalignmentTable = MisalignmentTable()
    camera: CameraTable = CameraTable()
    illumination: IlluminationTable = IlluminationTable()
    safety: SafetyTable = SafetyTable()
    faults: FaultTable = FaultTable()

    @model_validator(mode="after")
    def _pupil_of_the_camera_is_wider_than_its_edge(self) -> SimulatedRig:
        edge, pupil = self.optics.pupil_edge_mm, self.camera.pupil_mm
        if pupil is not None and edge >= pupil:
            raise ValueError(f"optics.pupil_edge_mm = {edge:g} is not below camera.pupil_mm = {pupil:g}")
        return self
