"""Whether the panel moves the light (P10), and whether the first frame after a change is the new picture (P11).

The loop knows no physics, so the panel is asked with plain levels: a random pattern spreads the light over every
direction, level 0 everywhere leaves it in one; a camera that cannot tell the two apart looks at something else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from holocal.loop.devices import Frame
from holocal.loop.preflight.checks import WARN, Check, check
from holocal.loop.preflight.with_light import EXPOSURE_SHARES, Bench
from holocal.loop.reference import Mask

Array = NDArray[np.float64]

MOVED_LIMIT = 3.0  # change of the picture over its noise
OLD_SHARE_LIMIT = 0.05  # of the former picture: the drift that P12 allows can pass for 2 %
SETTLED_SHARE = 0.2  # of the change of picture: two frames that are nearer than that to one another are of one picture
MOST_WAITED = 6  # frames
FRESH = "Check the camera's trigger and link."
SLOW = "Look for what is slow: the panel's settle time, the exposure, the camera's read-out, other programs."
SLOW_S = 10.0  # from a change of pattern to its picture; a 4K panel simulated on one core takes 2 s


def panel_checks(bench: Bench, darks: Sequence[Frame], series: Sequence[Frame]) -> list[Check]:
    """Return P10 and P11 from frames of level 0 and then, since it is to be left, of the random pattern again."""
    assert bench.shooter.reference is not None
    usable = bench.shooter.reference.usable
    same = [_counts(frame) for frame, share in zip(series, EXPOSURE_SHARES, strict=True) if share == 1.0]
    pattern = np.asarray(np.mean(same, axis=0))

    def blank_is_settled(frames: list[Frame]) -> bool:
        if len(frames) < 2:
            return False
        last = _counts(frames[-1])
        apart = _distance(last, _counts(frames[-2]), usable)
        return apart < SETTLED_SHARE * _distance(last, pattern, usable)

    blanks, blank_times = _until(blank_is_settled, bench.blank)
    blank = _counts(blanks[-1])
    noise = min(_distance(same[0], same[1], usable), _distance(blank, _counts(blanks[-2]), usable))
    noise = max(noise, 0.5)  # half a count: a noiseless camera still rounds

    def share_of_blank(frame: Frame) -> float:
        return _share(_counts(frame), pattern, blank, usable)

    again, again_times = _until(
        lambda frames: share_of_blank(frames[-1]) <= OLD_SHARE_LIMIT, lambda: bench.random(bench.exposure_s)
    )
    old = [
        _unsettled([_share(_counts(frame), blank, pattern, usable) for frame in blanks]),
        _unsettled([share_of_blank(frame) for frame in again]),
    ]
    waited_s = max(times[min(n, len(times) - 1)] for n, times in zip(old, (blank_times, again_times), strict=True))
    settle = "Raise the panel's settle time in the rig's file (its driver's table) until this is 0."
    return [
        check(
            "P10",
            "the panel moves the light: change over noise",
            round(_distance(blank, pattern, usable) / noise, 2),
            MOVED_LIMIT,
            "",
            "Check that the panel is on, gets this computer's output, and that the light is on and not blocked.",
            at_least=True,
        ),
        check("P11a", "frames of the former pattern after a change", float(max(old)), 0.0, "frames", settle),
        check("P11b", "from a change of pattern to its picture", round(waited_s, 3), SLOW_S, "s", SLOW, otherwise=WARN),
        fresh_frames([*darks, *series, *blanks, *again]),
    ]


def fresh_frames(frames: Sequence[Frame]) -> Check:
    """Return whether every frame has a number above the one before, and arrived whole (P11c)."""
    stale = sum(later.frame_id <= earlier.frame_id for earlier, later in pairwise(frames))
    bad = stale + sum(frame.lost_packets > 0 for frame in frames)
    return check(
        "P11c", "stale or incomplete frames", float(bad), 0.0, "frames", "Check the camera's trigger and link."
    )


def _until(done: Callable[[list[Frame]], bool], take: Callable[[], Frame]) -> tuple[list[Frame], list[float]]:
    """Return frames until they are `done`, at most MOST_WAITED, and when each was there, seconds after the start."""
    began = time.monotonic()
    frames: list[Frame] = []
    times: list[float] = []
    while len(frames) < MOST_WAITED:
        frames.append(take())
        times.append(time.monotonic() - began)
        if done(frames):
            break
    return frames, times


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


def _counts(frame: Frame) -> Array:
    return np.asarray(frame.counts, np.float64)
