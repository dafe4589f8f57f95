"""The table ``[camera]`` of a GenICam camera, and what its pixel format's name says of its counts."""

from __future__ import annotations

import math
import re
from typing import Literal

from pydantic import Field, model_validator

from holocal.records.rig_model import Pixels, Table

DEGREE = math.pi / 180
# Monochrome, unsigned, of the Pixel Format Naming Convention. "p" is packed bit by bit, "Packed" is GigE Vision's own.
PixelFormat = Literal[
    "Mono8", "Mono10", "Mono10p", "Mono10Packed", "Mono12", "Mono12p", "Mono12Packed", "Mono14", "Mono14p", "Mono16",
]  # fmt: skip


class GenicamTable(Table):
    """``[camera]`` with ``driver = "genicam"``.

    The camera is the only one that answers, or the one that `serial`, `user_id` or `address` (IPv4, GigE Vision) names.
    `interface` is the network card that it hangs on, by address or name. The region of interest is `width` x `height`
    pixels from `offset_x`, `offset_y` of the sensor; `field_deg` is the full angle that its width covers. `shift_bits`
    drops low bits of a camera that sends its counts left-justified. `gain_db` is left as it is where it is not given.
    `rotation_deg`, `k1` and `k2` are its geometry in the bench's frame, so after the mounting's turns, as a calibration
    target tells them: positive turns the camera from +x towards +y (`holocal.estimate.camera_lens`).
    """

    driver: Literal["genicam"] = "genicam"
    serial: str | None = None
    user_id: str | None = None
    address: str | None = None
    interface: str | None = None
    transport: Literal["gige", "usb3"] | None = None
    width: Pixels
    height: Pixels
    offset_x: int = Field(default=0, ge=0, le=65535)
    offset_y: int = Field(default=0, ge=0, le=65535)
    field_deg: float = Field(gt=0.0, le=120.0)
    rotation_deg: float = Field(default=0.0, ge=-180.0, le=180.0)
    k1: float = Field(default=0.0, ge=-10.0, le=10.0)
    k2: float = Field(default=0.0, ge=-100.0, le=100.0)
    pixel_format: PixelFormat = "Mono12"
    shift_bits: int = Field(default=0, ge=0, le=8)
    gain_db: float | None = Field(default=None, ge=-100.0, le=100.0)
    max_exposure_s: float = Field(default=1.0, gt=0.0, le=3600.0)
    packet_size: int | None = Field(default=None, ge=64, le=65535)
    timeout_s: float = Field(default=5.0, gt=0.0, le=600.0)  # beyond the exposure: read-out and network

    @model_validator(mode="after")
    def _shift_leaves_bits(self) -> GenicamTable:
        if self.shift_bits and self.pixel_format not in ("Mono10", "Mono12", "Mono14", "Mono16"):
            raise ValueError(f"shift_bits = {self.shift_bits}: {self.pixel_format} has no spare low bits")
        return self

    @property
    def bits(self) -> int:
        """Bits of a count, from the pixel format's name: what cameras say of their PixelSize is the wire's.

        Low bits that are dropped come off the 16 of the container.
        """
        found = re.match(r"Mono(\d+)", self.pixel_format)
        assert found is not None
        return min(int(found[1]), 16 - self.shift_bits)

    @property
    def full_scale(self) -> int:
        """The largest count."""
        return int(2**self.bits - 1)

    @property
    def field_rad(self) -> tuple[float, float]:
        """The full angles over width and height: the picture is rectilinear, its pixels are square."""
        half = math.tan(self.field_deg * DEGREE / 2)
        return self.field_deg * DEGREE, 2 * math.atan(half * self.height / self.width)


class CameraFile(Table):
    """The part of a rig's file that the driver reads; errors then name ``camera.<key>``."""

    camera: GenicamTable
