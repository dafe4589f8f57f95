"""What was recorded: the frames of a run directory in the order in which they were taken, or pictures of any origin.

A run that keeps every frame (``holocal run --keep-frames``) has in ``events.jsonl``, for every sitting, a line
``"event": "camera"`` with the camera's facts, and for every grab, retakes and the pre-flight included, a line::

    {"event": "grab", "step": 3, "shot": "square", "lit": true, "levels_sha256": "...", "asked_s": 0.02,
     "exposure_s": 0.02, "frame_id": 17, "lost_packets": 0, "file": "frames/grab-000017.png"}

`step` is -1 in the pre-flight. A run without such lines kept the frames that its report cites; the others are missing.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from holocal.errors import DeviceError, InputError
from holocal.records.facts import CameraFacts, SlmFacts
from holocal.records.files import read_json
from holocal.records.frames import read_counts

PREFLIGHT_STEP = -1
LOSSLESS = ("FFV1", "HFYU", "FFVH")  # what cv2 gives back pixel by pixel; MJPG and mp4v do not
PICTURES = (".png", ".tif", ".tiff")


@dataclass(frozen=True)
class Grab:
    """One frame that a camera gave: where its counts are, and under what it was taken."""

    label: str
    file: Path | None
    exposure_s: float
    asked_s: float
    frame_id: int
    lost_packets: int = 0
    lit: bool = True
    levels_sha256: str | None = None  # of the pattern; None where it was not written down


@dataclass(frozen=True)
class Recording:
    """Everything that a run's camera gave, and what camera and panel said of themselves."""

    grabs: tuple[Grab, ...]
    camera: CameraFacts
    slm: SlmFacts


class Counts(Protocol):
    """Where counts come from, by the number of the frame."""

    def __len__(self) -> int:
        """Return how many frames there are."""
        ...

    def counts(self, index: int) -> NDArray[np.uint16]:
        """Return one frame's (height, width) counts."""
        ...


@dataclass(frozen=True)
class RecordedCounts:
    """The frames of a run."""

    grabs: Sequence[Grab]

    def __len__(self) -> int:
        """Return how many frames there are."""
        return len(self.grabs)

    def counts(self, index: int) -> NDArray[np.uint16]:
        """Return one frame's counts."""
        grab = self.grabs[index]
        if grab.file is None:
            raise DeviceError(
                f"frame {index + 1} of {len(self)} of the run ({grab.label}) was not kept.",
                why="A run keeps the frames that its report cites, unless it is told to keep all.",
                fix="Replay a run that kept every frame.",
                measured=index + 1,
                limit=len(self),
                code="frame-not-kept",
            )
        return read_counts(grab.file)


@dataclass(frozen=True)
class PictureCounts:
    """Grey pictures of 8 or 16 bits."""

    files: Sequence[Path]

    def __len__(self) -> int:
        """Return how many frames there are."""
        return len(self.files)

    def counts(self, index: int) -> NDArray[np.uint16]:
        """Return one picture's counts."""
        path = self.files[index]
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
            found = "nothing that can be read" if pixels is None else f"{pixels.dtype} of shape {pixels.shape}"
            raise InputError(f"{path} is not a grey picture of 8 or 16 bits: {found}.", fix="Give the camera's counts.")
        return np.asarray(pixels, np.uint16)


class VideoCounts:
    """A lossless grey video of 8 bits, read from its beginning."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._video = cv2.VideoCapture(str(path))
        if not self._video.isOpened():
            raise InputError(f"{path} is not a video that can be read.", fix="Give an .avi of the codec FFV1.")
        code = int(self._video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("latin-1").upper()
        if code not in LOSSLESS:
            raise InputError(
                f"{path} has the codec {code!r}.",
                why="A lossy codec's counts are not those of the camera.",
                fix=f"Record with one of {', '.join(LOSSLESS)}.",
                measured=code,
                limit=list(LOSSLESS),
            )
        self._length = int(self._video.get(cv2.CAP_PROP_FRAME_COUNT))
        self._next = 0

    def __len__(self) -> int:
        """Return how many frames there are."""
        return self._length

    def counts(self, index: int) -> NDArray[np.uint16]:
        """Return one frame's counts; they are asked for in their order."""
        if index != self._next:
            raise ValueError(f"frame {index} was asked for; a video is read in order and {self._next} is next")
        done, pixels = self._video.read()
        if not done:
            raise InputError(f"{self._path} ends at frame {index} of {self._length}.", measured=index)
        self._next += 1
        if pixels.dtype != np.uint8 or (pixels.ndim == 3 and (pixels != pixels[..., :1]).any()):
            raise InputError(f"{self._path} is no grey video of 8 bits.", fix="Record the camera's counts as grey.")
        return np.asarray(pixels if pixels.ndim == 2 else pixels[..., 0], np.uint16)


def read_run(directory: Path) -> Recording:
    """Return what a run's camera gave, in the order of its journal.

    Of a run that was interrupted, the pre-flights of its later sittings are left out, and frame numbers go on where
    the sitting before stopped: what is replayed is the run as it would have been without the interruption.

    Raises
    ------
    InputError
        It is no run directory, or its journal names no frames.
    """
    identity = read_json(directory / "identity.json") if (directory / "identity.json").is_file() else None
    if identity is None:
        raise InputError(
            f"{directory} is not a run directory: it has no identity.json.", fix="Give a run's path in `run`."
        )
    lines = list(_journal(directory))
    try:
        grabs = tuple(_grabs(directory, lines)) or tuple(_kept_shots(directory, lines))
        if not grabs:
            raise InputError(f"{directory.name}: its journal names no frames.", fix="Replay a run that took frames.")
        said = next((line for line in lines if line["event"] == "camera"), None)
        return Recording(grabs, _camera(identity, said, grabs), _slm(identity))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{directory.name}: identity.json or events.jsonl is not as a run writes it: {error!r}.",
            fix="Check the run with `holocal verify`.",
        ) from error


def _journal(directory: Path) -> Iterator[Mapping[str, Any]]:
    path = directory / "events.jsonl"
    if not path.is_file():
        return
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            yield json.loads(text)
        except ValueError:  # the torn last line of a killed run
            return


def _grabs(directory: Path, lines: Sequence[Mapping[str, Any]]) -> Iterator[Grab]:
    """Yield a run's grabs, where it wrote them all down."""
    sittings, offset, last = 0, 0, -1
    for line in lines:
        if line["event"] == "camera":
            sittings += 1
            offset = last + 1 if sittings > 1 else 0
        if line["event"] != "grab" or (sittings > 1 and line["step"] == PREFLIGHT_STEP):
            continue
        last = offset + int(line["frame_id"])
        yield Grab(
            str(line["shot"]),
            _inside(directory, line["file"]),
            float(line["exposure_s"]),
            float(line["asked_s"]),
            last,
            int(line["lost_packets"]),
            bool(line["lit"]),
            line["levels_sha256"],
        )


def _kept_shots(directory: Path, lines: Sequence[Mapping[str, Any]]) -> Iterator[Grab]:
    """Yield the good frames of a run's steps and of its verification; the file of most was not kept."""
    shots = [shot for line in lines if line["event"] in ("step", "verified") for shot in line["shots"]]
    for number, shot in enumerate(shots):
        used_s = float(shot["exposure_s"])
        file = _inside(directory, shot["file"]) if shot.get("file") else None
        yield Grab(str(shot["label"]), file, used_s, used_s, number)


def _inside(directory: Path, name: str) -> Path:
    path = (directory / name).resolve()
    if not path.is_relative_to(directory.resolve()):
        raise ValueError(f"the file {name} lies outside of the run")
    return path


def _camera(identity: Mapping[str, Any], said: Mapping[str, Any] | None, grabs: Sequence[Grab]) -> CameraFacts:
    exposures = [grab.exposure_s for grab in grabs]
    limits = said or {"exposure_min_s": min(exposures), "exposure_max_s": max(exposures)}
    width_rad, height_rad = identity["camera.field_rad"]
    return CameraFacts(
        width=identity["camera.width"],
        height=identity["camera.height"],
        field_rad=(float(width_rad), float(height_rad)),
        full_scale=identity["camera.full_scale"],
        exposure_min_s=float(limits["exposure_min_s"]),
        exposure_max_s=float(limits["exposure_max_s"]),
        bits=identity["camera.bits"],
        vendor=identity["camera.vendor"],
        model=identity["camera.model"],
        serial=identity["camera.serial"],
        **{name: float((said or {}).get(name, 0.0)) for name in ("rotation_rad", "k1", "k2")},
    )


def _slm(identity: Mapping[str, Any]) -> SlmFacts:
    names = ("width", "height", "pitch_m", "bits", "vendor", "model", "serial")
    return SlmFacts(**{name: identity[f"slm.{name}"] for name in names})


def open_counts(path: Path) -> Counts:
    """Return the frames of a folder, of a pattern like ``frames/*.png``, or of a video, in the order of their names."""
    if path.is_file() and path.suffix.lower() not in PICTURES:
        return VideoCounts(path)
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in PICTURES]
    elif path.is_file():
        files = [path]
    else:
        files = list(path.parent.glob(path.name)) if path.parent.is_dir() else []
    if not files:
        raise InputError(
            f"{path} gives no frames.", fix="Give a folder of PNG or TIFF pictures, a pattern, or a video."
        )
    return PictureCounts(sorted(files))
