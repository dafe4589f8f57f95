"""What makes a frame unfit, each with its number and its limit."""

from __future__ import annotations

import numpy as np
import pytest

from holocal.loop import gates
from holocal.loop.devices import Frame
from holocal.records.facts import CameraFacts

CAMERA = CameraFacts(40, 30, (0.4, 0.3), 4095, 1e-5, 1.0)


def frame(counts=None, *, number=2, saturated=0.0, lost=0) -> Frame:
    if counts is None:
        counts = np.random.default_rng(3).integers(100, 4000, (30, 40)).astype(np.uint16)
    return Frame(counts, 0.01, number, saturated, lost)


def judged(found: Frame, *, last: Frame | None = None, last_id: int | None = 1, lit=True, changed=True):
    around = gates.Surroundings(last_id=last_id, last=last, lit=lit, changed=changed)
    failure = gates.first_failure(found, CAMERA, around)
    return None if failure is None else (failure.gate, failure.measured, failure.limit)


def test_a_good_frame_passes():
    assert judged(frame(), last=frame(np.zeros((30, 40), np.uint16), number=1)) is None


@pytest.mark.parametrize(
    ("bad", "expected"),
    [
        (frame(np.zeros((30, 39), np.uint16)), ("misshapen", 1170.0, 1200.0)),
        (frame(np.zeros((0, 0), np.uint16)), ("misshapen", 0.0, 1200.0)),
        (frame(np.full((30, 40), np.nan)), ("misshapen", 1200.0, 1200.0)),
        (frame(lost=2), ("lost-packets", 2.0, 0.0)),
        (frame(number=1), ("stale", 1.0, 1.0)),
        (frame(np.full((30, 40), 5000, np.uint16)), ("beyond-full-scale", 5000.0, 4095.0)),
        (frame(np.full((30, 40), 7, np.uint16)), ("constant", 0.0, 1.0)),
        (frame(frame().counts >> 4 << 4), ("low-bits-zero", 4.0, 1.0)),
    ],
)
def test_each_bad_frame_trips_its_gate(bad, expected):
    assert judged(bad) == expected


def test_the_same_picture_again_is_bad_only_when_something_changed():
    again = frame(number=3)
    assert judged(again, last=frame(), last_id=2) == ("identical", 1.0, 0.0)
    assert judged(again, last=frame(), last_id=2, changed=False) is None


def test_a_dark_frame_may_be_constant():
    assert judged(frame(np.zeros((30, 40), np.uint16)), lit=False) is None


def test_a_white_frame_is_left_to_the_gate_for_clipping():
    white = frame(np.full((30, 40), 4095, np.uint16), saturated=1.0)
    assert judged(white) is None
    assert not gates.clipped(white, limit=1e-4).ok
