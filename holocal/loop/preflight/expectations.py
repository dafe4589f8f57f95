"""What a rig is held against besides its own facts: its lock, its file, its accepted calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Expectations:
    """What the pre-flight should find.

    Attributes
    ----------
    lock
        The rig's lock, which this process should hold; None where nobody locks.
    identity
        Who says so -> dotted key of the rig's identity -> the value that is expected.
    measured_utc
        Calibration in force -> when it was measured; None where that is not known.
    max_age_days
        How old a calibration may be; None: any age, with a warning.
    """

    lock: Path | None = None
    identity: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    measured_utc: Mapping[str, datetime | None] = field(default_factory=dict)
    max_age_days: float | None = None


NOTHING_EXPECTED = Expectations()
