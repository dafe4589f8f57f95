"""The pixels of one monitor: what the panel would be sent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError
from rigs.hdmi import x_outputs
from rigs.hdmi.read_back import Reader


class Monitor:
    """A lit output of the X server that DISPLAY names; the level of a pixel is its red."""

    def __init__(self, name: str) -> None:
        known = {output.place.name: output.place for output in x_outputs.outputs()}
        if name not in known:
            raise ConfigError(
                f"the bench cannot look at the monitor {name!r}: it is not there.",
                fix=f"Monitors that are there: {', '.join(known) or 'none'}.",
                code="unknown-monitor",
            )
        self.place = known[name]
        self._reader: Reader | None = None

    def levels(self) -> NDArray[np.uint8]:
        """Return (height, width) levels as they are on the screen now."""
        if self._reader is None:  # opened by the thread that reads
            self._reader = Reader(self.place.x, self.place.y, self.place.width, self.place.height)
        return (self._reader.pixels() >> 16).astype(np.uint8)
