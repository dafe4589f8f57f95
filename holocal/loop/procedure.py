"""What a procedure is to the runner: a handful of pure functions on frozen state.

The runner alone touches devices, disk, clock and signals; a procedure never does. Its randomness comes from
(seed, step, shot) only, so that a resumed run ends with the same result as an uninterrupted one.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from holocal.loop.devices import Frame
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts


class Outcome(Enum):
    """How a loop stands after a step."""

    CONTINUE = "continue"
    TARGET_MET = "target met"
    STALLED = "stalled"
    DIVERGED = "diverged"
    OUT_OF_STEPS = "out of steps"


@dataclass(frozen=True)
class Judgement:
    """Whether to go on, and the sentence that is printed."""

    outcome: Outcome
    sentence: str


@dataclass(frozen=True)
class Shot:
    """One frame that a procedure wants.

    `levels` None means a dark frame: light off. `clip_limit` is the share of pixels that may be at full scale before
    the runner halves the exposure. `fresh` says that the pattern gives light, and a picture that differs from the
    former pattern's by more than noise, so that a panel that kept its pattern, or a light that went out, is noticed;
    set it False for steps too small to be seen in one frame, and for patterns that send no light into the picture.
    """

    label: str
    levels: NDArray[np.uint8] | None
    exposure_s: float
    wavelength_m: float
    clip_limit: float = 1e-4
    keep: bool = False
    fresh: bool = True


@dataclass(frozen=True)
class Plan:
    """What a run will do, known before anything is touched (``--dry-run``).

    `tolerated_drift` is the relative change of the light during the pre-flight's frames of one pattern that the target
    still stands; over the whole run it may be five times that.
    """

    frames: int
    steps: int
    expected_seconds: float
    exposure_ceiling_s: float
    sentences: tuple[str, ...] = ()
    tolerated_drift: float = 0.02


@dataclass(frozen=True)
class Figure:
    """A picture for the report: its data, not its drawing.

    `kind` is "map", "image", "curve", "pair", "histogram", "vectors", "sheet" or "corner". Vectors are arrays (n, 4),
    a panel for each: x and y in degrees, to the right and up in `unit`. A sheet is a contact sheet: "sheet" (rows x
    cell, columns x cell) from 0 to 1, "rows" (rows,) the values that its rows were taken with, `labels` its columns,
    and "best" (columns,) the value to mark in each, NaN for none. A corner shows the "samples" (k, d) of a posterior,
    at most the first 12 parameters, with the names `labels`; its arrays "truth" (d,), "laplace_mean" (d,) and
    "laplace_covariance" (d, d) are drawn over them where they are given.
    """

    name: str
    title: str
    kind: str
    arrays: Mapping[str, NDArray[Any]]
    unit: str = ""
    caption: str = ""
    extent_deg: tuple[float, float, float, float] | None = None  # left, right, bottom, top
    target: float | None = None
    labels: tuple[str, ...] = ()  # of a corner's parameters, a sheet's columns


@dataclass(frozen=True)
class Conclusion:
    """What a procedure found: the numbers of the contract, the maps, the pictures.

    `before`, `after`, `targets` have the contract's keys. `sigma` has the standard errors of their numbers, under
    "before" and "after" and, where a number lies in a table, the keys joined by "_" as in `targets`: what comparisons
    over time are judged by. `targets_met` is set by the procedure. `maps` go to ``maps.exr`` (name -> (height, width)
    float32), `before_map` and `after_map` to ``before.exr`` and ``after.exr``; `calibration` holds what `accept` would
    put in force: JSON scalars here, arrays in `maps`. `parts` are the results of a run of several procedures, by their
    names, in the order in which they were measured; each is accepted as if it had been a run by itself.
    `extra["tables"]` are for the report: each a `title`, `columns`, `rows` (lists of words and numbers), a `caption`.
    """

    before: dict[str, Any]
    after: dict[str, Any]
    targets: dict[str, float]
    targets_met: bool
    sentence: str
    maps: Mapping[str, NDArray[np.float32]]
    before_map: NDArray[np.float32]
    after_map: NDArray[np.float32]
    map_units: Mapping[str, str] = field(default_factory=dict)
    map_metadata: Mapping[str, Any] = field(default_factory=dict)  # further metadata of the maps' file
    extent_deg: tuple[float, float, float, float] | None = None
    sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)  # further keys of result.json
    figures: tuple[Figure, ...] = ()
    parts: Mapping[str, Conclusion] = field(default_factory=dict)


State = TypeVar("State")


class Procedure(Protocol[State]):
    """A closed loop as pure functions. `State` is a frozen dataclass of arrays, numbers, strings and tuples of these.

    The runner does, in this order::

        state = start(facts, calibration, parameters, seed)
        repeat  frames = [shoot(shot) for shot in stimuli(state)]
                state = update(state, frames)          # estimate included; journal, then checkpoint
                judgement = judge(state)               # printed
        until judgement.outcome is not CONTINUE
        frames = [shoot(shot) for shot in verification(state)]
        conclusion = conclude(state, frames)
    """

    name: str
    parameters_model: type[BaseModel]

    def plan(self, facts: RigFacts, parameters: Any) -> Plan:
        """Return what a run would do, touching nothing."""
        ...

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Any, seed: int) -> State:
        """Return the first state."""
        ...

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield this step's shots; each is computed only when the runner asks for it."""
        ...

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state after this step's frames, estimate included."""
        ...

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step: JSON scalars, the goal's number under "value" and its sigma under
        "sigma", the target under "target", the unit or name of the number under "quantity"."""
        ...

    def judge(self, state: State) -> Judgement:
        """Return whether to go on."""
        ...

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield the shots of the verification: fresh frames that no estimate has seen."""
        ...

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result, "after" measured on the verification's frames only."""
        ...


@runtime_checkable
class ToldOfCamera(Protocol):
    """What a procedure adds when it builds on what the pre-flight found of the camera.

    The runner tells it once, after `start`: dark level, noise law, hot pixels, and a random pattern's light.
    """

    def with_camera(self, state: Any, reference: Reference) -> Any:
        """Return the first state, told."""
        ...


@runtime_checkable
class AgainstTruth(Protocol):
    """What a procedure adds when its result can be held against a simulated rig's truth.

    The runner asks once the conclusion is drawn, for ``truth`` in `result.json` alone: no estimate can depend on it.
    """

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
        """Return how far a conclusion is from the truth, JSON-ready."""
        ...


@dataclass(frozen=True)
class Remeasured:
    """What a calibration leaves now: numbers under the keys of its result's `targets`, and their standard errors."""

    after: Mapping[str, float]
    sigma: Mapping[str, float]


@runtime_checkable
class Checkable(Protocol):
    """What a procedure adds when its accepted result can be measured again in a few frames (`holocal check`)."""

    def remeasure(
        self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Any, reference: Reference, seed: int
    ) -> Generator[Shot, Frame, Remeasured]:
        """Yield the shots under the calibration in force, be sent the frame of each, return what it leaves.

        `calibration` is as in `start`, the procedure's own accepted run among it; `parameters` are those of that run,
        `reference` is what the pre-flight learnt of the camera.

        Raises
        ------
        RefusedError, InputError
            The frames do not show what the calibration says they should.
        """
        ...


def taken(shots: Iterable[Shot]) -> Generator[Shot, Frame, tuple[Frame, ...]]:
    """Yield shots and return the frames that were sent for them: ``frames = yield from taken(shots)``."""
    frames = []
    for shot in shots:
        frame = yield shot
        frames.append(frame)
    return tuple(frames)
