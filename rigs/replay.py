"""A bench that is a record: yesterday's frames again, without the bench, the same counts every time.

    [camera]
    driver = "replay"
    run = "runs/20261122T204012Z-uniformity-7f3k"     # its frames, with their exposures, in the order of its journal

    [slm]
    driver = "replay"
    run = "runs/20261122T204012Z-uniformity-7f3k"
    patterns = "same"      # a pattern other than the recorded one is an error; "any": it is let pass

    [light]
    driver = "replay"

or, of pictures that no run made (no loop can be closed on them, an estimator can be run)::

    [camera]
    driver = "replay"
    frames = "pictures/*.png"      # or a folder, or a lossless video
    bits = 12
    field_deg = 25.0
    exposure_s = 0.01

A closed loop replays as long as it asks for what was recorded: every exposure, and with `patterns` = "same" every
pattern, is held against the record.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from holocal.errors import ConfigError, DeviceError
from holocal.loop.devices import Frame, Shown
from holocal.records.facts import CameraFacts, SlmFacts
from holocal.records.rig_model import Table
from holocal.records.validate import validated
from rigs.context import DriverContext
from rigs.recorded import Counts, Grab, RecordedCounts, open_counts, read_run

LINE_WIDTH_M = 1e-9


class CameraTable(Table):
    """``[camera]`` with ``driver = "replay"``: a `run`, or `frames` with what their camera was."""

    driver: Literal["replay"] = "replay"
    run: str | None = Field(default=None, min_length=1)
    frames: str | None = Field(default=None, min_length=1)
    bits: int | None = Field(default=None, ge=1, le=16)
    field_deg: float | None = Field(default=None, gt=0.0, le=120.0)
    rotation_deg: float = Field(default=0.0, ge=-180.0, le=180.0)
    k1: float = Field(default=0.0, ge=-10.0, le=10.0)
    k2: float = Field(default=0.0, ge=-100.0, le=100.0)
    exposure_s: float | None = Field(default=None, gt=0.0, le=3600.0)
    # A camera rounds an exposure to its line time, and a float to 64 bits; another procedure's are tens of percent off.
    exposure_tolerance: float = Field(default=0.01, ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _either_a_run_or_frames(self) -> CameraTable:
        if (self.run is None) == (self.frames is None):
            raise ValueError("give either run or frames")
        known = {"bits": self.bits, "field_deg": self.field_deg, "exposure_s": self.exposure_s}
        wrong = [key for key, value in known.items() if (value is None) != (self.run is not None)]
        if wrong and self.run is not None:
            raise ValueError(f"a run says {', '.join(wrong)} itself")
        geometry = [key for key in ("rotation_deg", "k1", "k2") if getattr(self, key)]
        if geometry and self.run is not None:
            raise ValueError(f"a run says {', '.join(geometry)} itself")
        if wrong:
            raise ValueError(f"frames do not say {', '.join(wrong)}: add it")
        return self


class SlmTable(Table):
    """``[slm]`` with ``driver = "replay"``."""

    driver: Literal["replay"] = "replay"
    run: str = Field(min_length=1)
    patterns: Literal["same", "any"] = "same"


class LightTable(Table):
    """``[light]`` with ``driver = "replay"``: there is nothing to switch."""

    driver: Literal["replay"] = "replay"


def open_camera(table: Mapping[str, Any], context: DriverContext) -> ReplayCamera:
    """Return the camera of a record.

    Raises
    ------
    ConfigError
        A key is wrong.
    InputError
        There is no such record, or it holds no frames.
    """
    checked = validated(CameraTable, table, source=f"{context.source}, [camera]")
    if checked.run is not None:
        recording = read_run(_path(checked.run, context))
        return ReplayCamera(recording.grabs, RecordedCounts(recording.grabs), recording.camera, checked)
    counts = open_counts(_path(str(checked.frames), context))
    return _camera_of_pictures(counts, checked, context)


def open_slm(table: Mapping[str, Any], context: DriverContext) -> ReplaySlm:
    """Return the panel of a record: it shows nothing, and knows what was shown."""
    checked = validated(SlmTable, table, source=f"{context.source}, [slm]")
    recording = read_run(_path(checked.run, context))
    return ReplaySlm(recording.slm, recording.grabs, strict=checked.patterns == "same")


def open_light(table: Mapping[str, Any], context: DriverContext) -> ReplayLight:
    """Return a light that is none."""
    validated(LightTable, table, source=f"{context.source}, [light]")
    return ReplayLight(context.wavelengths_m)


class ReplayCamera:
    """Gives the recorded frames one after the other, each with the exposure that it was taken with."""

    def __init__(self, grabs: tuple[Grab, ...], counts: Counts, facts: CameraFacts, table: CameraTable) -> None:
        self._grabs, self._counts, self._facts = grabs, counts, facts
        self._tolerance = table.exposure_tolerance
        self._source = table.run or table.frames
        self._next = 0

    def describe(self) -> CameraFacts:
        """Return the facts of the camera that took the frames."""
        return self._facts

    def set_exposure(self, exposure_s: float) -> float:
        """Return the exposure of the next recorded frame, when that is what was asked for then too."""
        if not math.isfinite(exposure_s) or exposure_s <= 0:
            raise ConfigError(f"an exposure of {exposure_s} s was asked for.", fix="Ask for one above 0 s.")
        if self._next >= len(self._grabs):
            return exposure_s  # a loop that ends may set it without taking a frame; `grab` would say that there is none
        grab = self._grabs[self._next]
        off = abs(exposure_s / grab.asked_s - 1.0)
        if off > self._tolerance:
            raise DeviceError(
                f"frame {self._next + 1} of {self._source} ({grab.label}) was taken with {1e3 * grab.asked_s:.6g} ms; "
                f"now {1e3 * exposure_s:.6g} ms are asked for.",
                why="What is replayed is another measurement.",
                fix="Use the procedure, seed and parameters of the recorded run; of a run whose exposure was halved "
                "only a record of every frame can be replayed.",
                measured=exposure_s,
                limit=grab.asked_s,
                code="replay-exposure",
            )
        return grab.exposure_s

    def grab(self) -> Frame:
        """Return the next recorded frame; `DeviceError` beyond the last."""
        if self._next >= len(self._grabs):
            raise DeviceError(
                f"{self._source} has {len(self._grabs)} frames; frame {self._next + 1} was asked for.",
                why="What was not measured cannot be replayed.",
                fix="Ask for fewer steps, or replay a longer record.",
                measured=self._next + 1,
                limit=len(self._grabs),
                code="replay-end",
            )
        grab, counts = self._grabs[self._next], self._counts.counts(self._next)
        self._next += 1
        shape = (self._facts.height, self._facts.width)
        if counts.shape != shape:
            raise DeviceError(
                f"frame {self._next} of {self._source} has {counts.shape[1]} x {counts.shape[0]} pixels; the camera "
                f"has {shape[1]} x {shape[0]}.",
                measured=list(counts.shape),
                limit=list(shape),
                code="replay-size",
            )
        saturated = float(np.mean(counts >= self._facts.full_scale))
        return Frame(counts, grab.exposure_s, grab.frame_id, saturated, grab.lost_packets)


class ReplaySlm:
    """A panel that shows nothing; each pattern may be held against the one that was shown then."""

    def __init__(self, facts: SlmFacts, grabs: tuple[Grab, ...], *, strict: bool) -> None:
        self._facts = facts
        shown = [grab.levels_sha256 for grab in grabs if grab.lit and grab.levels_sha256]
        # The loop does not show a pattern again that is on the panel already.
        self._patterns = [sha for i, sha in enumerate(shown) if i == 0 or sha != shown[i - 1]] if strict else []
        self._next = 0

    def describe(self) -> SlmFacts:
        """Return the facts of the panel that was there."""
        return self._facts

    def show(self, levels: NDArray[np.uint8]) -> Shown:
        """Take a pattern; `DeviceError` where another one was shown when the frames were taken."""
        if levels.dtype != np.uint8 or levels.shape != (self._facts.height, self._facts.width):
            raise DeviceError(
                f"the recorded panel takes {self._facts.width} x {self._facts.height} levels of 8 bits; it was given "
                f"{levels.dtype} of shape {levels.shape}."
            )
        sha = hashlib.sha256(np.ascontiguousarray(levels).data).hexdigest()
        if self._next < len(self._patterns):
            if sha != self._patterns[self._next]:
                raise DeviceError(
                    f"pattern {self._next + 1} is another than the recorded one.",
                    why="The recorded frames do not show what this pattern does.",
                    fix="Use the procedure, seed and parameters of the recorded run; or set slm.patterns = "
                    '"any" to see what an estimator makes of the old frames all the same.',
                    measured=sha,
                    limit=self._patterns[self._next],
                    code="replay-pattern",
                )
            self._next += 1
        return Shown(sha, read_back_ok=None)

    def blank(self) -> None:
        """Do nothing: the panel shows nothing."""


class ReplayLight:
    """A light that was on when the frames were taken."""

    def __init__(self, wavelengths_m: tuple[float, ...]) -> None:
        self._wavelengths_m = wavelengths_m

    def select(self, wavelength_m: float) -> None:
        """Accept one of the rig's lines."""
        if all(abs(line - wavelength_m) > LINE_WIDTH_M for line in self._wavelengths_m):
            lines = ", ".join(f"{line * 1e9:g}" for line in self._wavelengths_m)
            raise ConfigError(
                f"the rig has no laser line at {wavelength_m * 1e9:g} nm.",
                fix=f"Choose one of {lines} nm.",
                limit=lines,
            )

    def on(self) -> None:
        """Do nothing."""

    def off(self) -> None:
        """Do nothing."""


def _camera_of_pictures(counts: Counts, table: CameraTable, context: DriverContext) -> ReplayCamera:
    assert table.exposure_s is not None
    assert table.field_deg is not None
    assert table.bits is not None
    first = open_counts(_path(str(table.frames), context)).counts(0)  # a source of its own: a video has no way back
    height, width = first.shape
    field_rad = math.radians(table.field_deg)
    facts = CameraFacts(
        width=width,
        height=height,
        field_rad=(field_rad, 2 * math.atan(math.tan(field_rad / 2) * height / width)),  # square pixels
        full_scale=2**table.bits - 1,
        exposure_min_s=table.exposure_s,
        exposure_max_s=table.exposure_s,
        bits=table.bits,
        model="recorded pictures",
        rotation_rad=math.radians(table.rotation_deg),
        k1=table.k1,
        k2=table.k2,
    )
    exposure_s = table.exposure_s
    grabs = tuple(Grab(f"frame {i + 1}", None, exposure_s, exposure_s, i) for i in range(len(counts)))
    return ReplayCamera(grabs, counts, facts, table)


def _path(name: str, context: DriverContext) -> Path:
    """Return a path of a rig's file: beside that file, unless it is absolute."""
    return Path(context.source).parent / name
