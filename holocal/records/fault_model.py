"""``[faults]`` of a simulated rig's file: what is to go wrong, and when. For tests of the gates, and for drills.

All are off by default. Grabs and shows are counted from 1 in every process, the pre-flight's included; `result.json`
says how many frames the pre-flight took (``preflight_frames``). A resumed run has no faults: the drill is over.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Count = Annotated[int, Field(ge=1, le=1_000_000)]
SensorPixels = Annotated[int, Field(ge=1, le=16384)]


class FaultTable(BaseModel):
    """What goes wrong, one key per fault; `at` means that one time, `from` that time and ever after.

    Attributes
    ----------
    stale_at_grab, stale_from_grab
        The camera gives the frame before once more, number and all.
    repeated_from_grab
        The same, but under fresh numbers: a driver that counts what it hands out.
    dropped_at_grab
        No frame comes; the driver times out.
    truncated_at_grab
        The lower half of the frame is missing, and the driver counts lost packets.
    short_at_grab
        The frame has fewer rows than the camera, and nothing is said to be lost.
    nan_at_grab
        A frame of not-a-numbers, as a driver that averages nothing gives.
    lose_camera_from_grab, lose_slm_from_show, lose_light_from_grab
        The device does not answer any more; a lost light leaves the frames dark and says nothing.
    saturate_from_grab, saturate_factor
        The light becomes so many times brighter.
    drift_per_grab
        Relative change of the light from each grab to the next.
    mirror
        The camera's picture is mirrored: "x" left and right, "y" top and bottom, "xy" both, which is half a turn.
    swapped_camera, swapped_size
        Another camera is plugged in: another serial number and, where given, another size (width, height).
    left_justified
        The counts come shifted to the top of 16 bits, and the camera calls 65535 its full scale.
    ignore_show_at, ignore_shows_from
        The panel keeps its pattern when it is told to show another.
    read_back
        What the panel then says of it: "lies" (all is well), "honest" (it differs) or "none" (cannot be read back).
    output_gamma
        Levels go through this power between the frame buffer, whose read-back stays exact, and the panel.
    latency_frames
        For so many grabs after a change of pattern the picture is still the former pattern's.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    stale_at_grab: Count | None = None
    stale_from_grab: Count | None = None
    repeated_from_grab: Count | None = None
    dropped_at_grab: Count | None = None
    truncated_at_grab: Count | None = None
    short_at_grab: Count | None = None
    nan_at_grab: Count | None = None
    lose_camera_from_grab: Count | None = None
    lose_slm_from_show: Count | None = None
    lose_light_from_grab: Count | None = None
    saturate_from_grab: Count | None = None
    saturate_factor: float = Field(default=100.0, gt=1.0, le=1e6)
    drift_per_grab: float = Field(default=0.0, ge=-0.5, le=0.5)
    mirror: Literal["none", "x", "y", "xy"] = "none"
    swapped_camera: bool = False
    swapped_size: tuple[SensorPixels, SensorPixels] | None = None
    left_justified: bool = False
    ignore_show_at: Count | None = None
    ignore_shows_from: Count | None = None
    read_back: Literal["lies", "honest", "none"] = "lies"
    output_gamma: float = Field(default=1.0, ge=0.1, le=10.0)
    latency_frames: int = Field(default=0, ge=0, le=100)

    def active(self) -> dict[str, object]:
        """Return the keys that differ from their defaults, with their values."""
        return self.model_dump(mode="json", exclude_defaults=True)
