"""Seconds per stage of a hologram."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass
class Clock:
    """Seconds per stage, and when the last stage ended."""

    seconds: dict[str, float]
    last: float

    @classmethod
    def start(cls) -> Clock:
        """Return a clock that has just begun."""
        return cls({}, time.perf_counter())

    def lap(self, stage: str) -> None:
        """Book the time since the last lap."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now
