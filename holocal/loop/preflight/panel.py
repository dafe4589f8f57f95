"""Whether the panel moves the light (P10), and whether the first frame after a change is the new picture (P11).

The loop knows no physics, so the panel is asked with plain levels: a random pattern spreads the light over every
direction, level 0 everywhere leaves it in one; a camera that cannot tell the two apart looks at something else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame
from holocal.loop.preflight.checks import FAIL, WARN, Check, check, unknown
from holocal.loop.preflight.with_light import Bench
from holocal.loop.reference import Mask

Array = NDArray[np.float64]

MOVED_LIMIT = 3.0  # change of the picture over its noise
OLD_SHARE_LIMIT = 0.05  # of the former picture: the drift that P12 allows can pass for 2 %
SETTLED_SHARE = 0.2  # of the change of picture: two frames that are nearer than that to one another are of one picture
MOST_WAITED = 6  # frames
FRESH = "Check the camera's trigger and link."
SLOW = "Look for what is slow: the panel's settle time, the exposure, the camera's read-out, other programs."
SLOW_S = 30.0  # from a change of pattern to its picture; a simulated 4K panel took 11 s on a busy machine of 2 cores


@dataclass(frozen=True)
class Change:
    """The frames after a change of pattern, and when each was there, seconds after it."""

    frames: list[Frame]
    times_s: list[float]


def change_to_blank(bench: Bench, pattern: Array, usable: Mask) -> Change:
    """Return frames of level 0 everywhere until two are of one picture that is not the `pattern`'s, at most six."""

    def settled(frames: list[Frame]) -> bool:
        if len(frames) < 2:
            return False
        last = counts_of(frames[-1])
        apart = _distance(last, counts_of(frames[-2]), usable)
        return apart < SETTLED_SHARE * _distance(last, pattern, usable)

    return _until(settled, bench.blank)


def change_to_pattern(bench: Bench, pattern: Array, blank: Array, usable: Mask) -> Change:
    """Return frames of the random pattern until one is its picture, at most six."""
    return _until(
        lambda frames: _share(counts_of(frames[-1]), pattern, blank, usable) <= OLD_SHARE_LIMIT,
        lambda: bench.random(bench.exposure_s),
    )


def panel_checks(same: Sequence[Frame], to_blank: Change, to_pattern: Change, usable: Mask) -> list[Check]:
    """Return P10, P11a and P11b from frames of the random pattern, of level 0, and of the pattern again."""
    pattern, blank = mean_picture(same), counts_of(to_blank.frames[-1])
    pairs = (same[0], same[1]), tuple(to_blank.frames[-2:])
    noise = min(_distance(counts_of(one), counts_of(other), usable) for one, other in pairs)
    noise = max(noise, 0.5)  # half a count: a noiseless camera still rounds
    moved = check(
        "P10",
        "the panel moves the light: change over noise",
        round(_distance(blank, pattern, usable) / noise, 2),
        MOVED_LIMIT,
        "",
        "Check that the panel is on, gets this computer's output, and that the light is on and not blocked.",
        at_least=True,
    )
    titles = "frames of the former pattern after a change", "from a change of pattern to its picture"
    if moved.verdict == FAIL:
        return [moved, unknown("P11a", titles[0], "See P10."), unknown("P11b", titles[1], "See P10.")]
    old = [
        _unsettled([_share(counts_of(frame), blank, pattern, usable) for frame in to_blank.frames]),
        _unsettled([_share(counts_of(frame), pattern, blank, usable) for frame in to_pattern.frames]),
    ]
    changes = (to_blank.times_s, to_pattern.times_s)
    waited_s = max(times[min(n, len(times) - 1)] for n, times in zip(old, changes, strict=True))
    settle = "Raise the panel's settle time in the rig's file (its driver's table) until this is 0."
    return [
        moved,
        check("P11a", titles[0], float(max(old)), 0.0, "frames", settle),
        check("P11b", titles[1], round(waited_s, 3), SLOW_S, "s", SLOW, otherwise=WARN),
    ]


def fresh_frames(frames: Sequence[Frame]) -> Check:
    """Return whether every frame has a number above the one before, and arrived whole (P11c)."""
    stale = sum(later.frame_id <= earlier.frame_id for earlier, later in pairwise(frames))
    bad = stale + sum(frame.lost_packets > 0 for frame in frames)
    return check(
        "P11c", "stale or incomplete frames", float(bad), 0.0, "frames", "Check the camera's trigger and link."
    )


def mean_picture(frames: Sequence[Frame]) -> Array:
    """Return the mean counts of frames, (height, width)."""
    return np.asarray(np.mean([counts_of(frame) for frame in frames], axis=0))


def counts_of(frame: Frame) -> Array:
    """Return a frame's counts as float64, (height, width)."""
    return np.asarray(frame.counts, np.float64)


def _until(done: Callable[[list[Frame]], bool], take: Callable[[], Frame]) -> Change:
    """Return frames until they are `done`, at most MOST_WAITED."""
    began = time.monotonic()
    frames: list[Frame] = []
    times: list[float] = []
    while len(frames) < MOST_WAITED:
        frames.append(take())
        times.append(time.monotonic() - began)
        if done(frames):
            break
    return Change(frames, times)


def _unsettled(shares: Sequence[float]) -> int:
    """Return how many frames came up to and with the last that holds too much of the former picture."""
    return max((number for number, share in enumerate(shares, 1) if share > OLD_SHARE_LIMIT), default=0)


def _share(picture: Array, new: Array, old: Array, usable: Mask) -> float:
    """Return how much of the way from `new` to `old` a picture lies: 0 is new, 1 is old; noise averages out."""
    way = (old - new)[usable]
    length = float(way @ way)
    return float((picture - new)[usable] @ way) / length if length > 0 else 0.0


def _distance(one: Array, other: Array, usable: Mask) -> float:
    return float(np.sqrt(np.mean((one - other)[usable] ** 2)))
