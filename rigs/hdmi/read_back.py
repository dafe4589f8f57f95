"""The pixels that the display server says are on an output: what was shown, with whatever lies on top of it."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError, DeviceError

COLOUR = np.uint32(0x00FFFFFF)  # red, green and blue of a pixel; the fourth byte means nothing


class Reader:
    """Reads one rectangle of the screen; on X11 over a connection of its own."""

    def __init__(self, x: int, y: int, width: int, height: int) -> None:
        self._region = {"left": x, "top": y, "width": width, "height": height}
        self._shape = (height, width)
        self._mss: Any = None
        try:
            import mss
            from mss.exception import ScreenShotError
        except ImportError as error:
            raise ConfigError(
                f"the read-back of the panel needs the package mss: {error}.",
                fix='Install it with `pip install "holocal[hdmi]"`, or set verify = "never" in [slm].',
                code="missing-package",
            ) from error
        self._failure = ScreenShotError
        try:
            self._mss = mss.MSS(with_cursor=False) if sys.platform.startswith("linux") else mss.MSS()
        except ScreenShotError as error:
            raise DeviceError(
                f"the screen cannot be read back: {error}.",
                why="Whether the panel shows its pattern would not be known.",
                fix='Install what is missing, or set verify = "never" in [slm].',
                code="no-read-back",
            ) from error

    def pixels(self) -> NDArray[np.uint32]:
        """Return (height, width) pixels, 0x00RRGGBB."""
        try:
            shot = self._mss.grab(self._region)
        except self._failure as error:
            raise DeviceError(
                f"the panel's output cannot be read back: {error}.",
                why="What is on the panel is not known.",
                fix="Check that the display server runs and that the monitor has kept its mode.",
                code="no-read-back",
            ) from error
        raw: NDArray[np.uint32] = np.frombuffer(shot.raw, "<u4")
        if raw.size != self._shape[0] * self._shape[1]:  # a scaled desktop gives other pixels than it was asked for
            raise DeviceError(
                f"the read-back has {raw.size} pixels; the panel has {self._shape[1]} x {self._shape[0]}.",
                fix="Set the desktop's scale to 100 %.",
                measured=raw.size,
                limit=self._shape[0] * self._shape[1],
                code="no-read-back",
            )
        return raw.reshape(self._shape) & COLOUR

    def close(self) -> None:
        """Let the screen go; safe to call twice."""
        if self._mss is not None:
            self._mss.close()
            self._mss = None

    def __enter__(self) -> Reader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
