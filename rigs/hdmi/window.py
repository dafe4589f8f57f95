"""A full-screen window on one monitor and its pixels, by SDL2's window surface: no OpenGL, no scaling, no filter.

SDL belongs to the thread that opened the window: every call from another one is refused here (on macOS it must be the
main thread). SDL takes no signal: SIGINT and SIGTERM stay Python's.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError, DeviceError
from rigs.hdmi import x_guard

TITLE = b"holocal: phase panel"
PATIENCE_S = 3.0  # for a window manager to put the window on its place
RED, GREEN, BLUE = 0xFF0000, 0x00FF00, 0x0000FF

# Set before SDL starts. A window that loses the focus stays where it is; a long computation is not "not responding",
# whose dialog would cover the panel; a compositor is asked to let the pixels through.
HINTS = {
    b"SDL_NO_SIGNAL_HANDLERS": b"1",
    b"SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": b"0",
    b"SDL_VIDEO_X11_NET_WM_PING": b"0",
    b"SDL_VIDEO_X11_NET_WM_BYPASS_COMPOSITOR": b"1",
    b"SDL_WINDOWS_DPI_AWARENESS": b"permonitorv2",
}

Fill = Callable[[NDArray[np.uint32]], None]


@dataclass(frozen=True)
class Place:
    """A monitor's name, its rectangle on the desktop in pixels, and its refresh rate (0: not known)."""

    name: str
    x: int
    y: int
    width: int
    height: int
    refresh_hz: float


def load_sdl() -> ModuleType:
    """Return the module sdl2, or raise `ConfigError` that says how to install it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # it warns that it uses the library of pysdl2-dll
            import sdl2
            import sdl2.syswm
    except ImportError as error:
        raise ConfigError(
            f"a panel on a monitor output needs the package pysdl2: {error}.",
            fix='Install it with `pip install "holocal[hdmi]"`.',
            code="missing-package",
        ) from error
    return sdl2  # type: ignore[no-any-return]


def require_display() -> None:
    """Raise `ConfigError` where there is no display: SDL would take the console of a computer without a desktop."""
    if sys.platform in ("win32", "darwin") or os.environ.get("SDL_VIDEODRIVER"):
        return
    if not os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY"):
        raise ConfigError(
            "there is no display: neither DISPLAY nor WAYLAND_DISPLAY is set.",
            why="The panel is a monitor of a desktop session.",
            fix="Start from that session, or name it: `DISPLAY=:0 holocal ...`.",
            code="no-display",
        )


def start_sdl() -> ModuleType:
    """Return SDL with its video started; each start is ended by one ``SDL_QuitSubSystem``."""
    require_display()
    sdl = load_sdl()
    if x_guard.lost():
        raise DeviceError(
            "this process lost its display server before.",
            why="SDL would wait for that server's answer for ever.",
            fix="Start the program again.",
            code="display-lost",
        )
    for name, value in HINTS.items():
        sdl.SDL_SetHint(name, value)
    if sdl.SDL_InitSubSystem(sdl.SDL_INIT_VIDEO):
        raise DeviceError(
            f"the display cannot be opened: {sdl.SDL_GetError().decode()}.",
            fix="Check DISPLAY and the permission to use it (xauth).",
            code="no-display",
        )
    driver = sdl.SDL_GetCurrentVideoDriver()
    if driver in (b"x11", b"windows"):  # elsewhere SDL has no other surface than a texture
        sdl.SDL_SetHint(b"SDL_FRAMEBUFFER_ACCELERATION", b"0")
    return sdl


def sdl_places() -> tuple[Place, ...]:
    """Return the monitors as SDL names them; on X11 `rigs.display_state` knows the outputs' own names."""
    sdl = start_sdl()
    try:
        return tuple(_place(sdl, index) for index in range(sdl.SDL_GetNumVideoDisplays()))
    finally:
        sdl.SDL_QuitSubSystem(sdl.SDL_INIT_VIDEO)


def _place(sdl: ModuleType, index: int) -> Place:
    bounds, mode = sdl.SDL_Rect(), sdl.SDL_DisplayMode()
    sdl.SDL_GetDisplayBounds(index, ctypes.byref(bounds))
    sdl.SDL_GetCurrentDisplayMode(index, ctypes.byref(mode))
    name = (sdl.SDL_GetDisplayName(index) or b"").decode(errors="replace")
    return Place(name, bounds.x, bounds.y, bounds.w, bounds.h, float(mode.refresh_rate))


class PanelWindow:
    """A full-screen window on a monitor. `present` fills and shows it; `close` ends it, twice too."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self._thread = threading.get_ident()
        self._sdl = sdl = start_sdl()
        self.driver = sdl.SDL_GetCurrentVideoDriver().decode()
        self._connection = x_guard.Connection()
        self._display, self._closed = 0, False
        flags = sdl.SDL_WINDOW_FULLSCREEN_DESKTOP | sdl.SDL_WINDOW_BORDERLESS | sdl.SDL_WINDOW_ALWAYS_ON_TOP
        self._window = sdl.SDL_CreateWindow(TITLE, place.x, place.y, place.width, place.height, flags)
        try:
            if not self._window:
                raise self._failed("the panel's window cannot be opened")
            if self.driver == "x11":
                self._guard()
            sdl.SDL_DisableScreenSaver()
            sdl.SDL_ShowCursor(sdl.SDL_DISABLE)
            self._wait_until_placed()
        except BaseException:
            self.close()
            raise

    @property
    def is_open(self) -> bool:
        """Whether the window is there and its display server too."""
        return bool(self._window) and not self._connection.lost

    @property
    def holds_screen_saver(self) -> bool:
        """Whether screen saver and power saving are held off while the window is open."""
        return self.is_open and not self._sdl.SDL_IsScreenSaverEnabled()

    def present(self, fill: Fill) -> None:
        """Let `fill` write the (height, width) pixels 0x00RRGGBB of the window, and show them.

        On X11 the display server has them when this returns.

        Raises
        ------
        DeviceError
            The window is closed, its monitor changed, or the display server is lost.
        """
        self._require_open()
        self._pump()
        surface = self._sdl.SDL_GetWindowSurface(self._window)
        self._require_connected()
        if not surface:
            raise self._failed("the panel's window has no surface")
        fill(self._pixels(surface.contents))
        self._connection.refused.clear()
        failed = self._sdl.SDL_UpdateWindowSurface(self._window)  # on X11 it waits for the server's answer
        self._require_connected()
        if failed:
            raise self._failed("the panel's window cannot be shown")
        if self._connection.refused:
            raise DeviceError(
                f"the display server refused the pixels (error and request: {self._connection.refused}).",
                fix="Check that the monitor has kept its mode.",
                code="window",
            )

    def close(self) -> None:
        """Close the window; safe to call twice, and after the display server is lost."""
        if self._closed:
            return
        self._require_thread()
        if self._window and not self._connection.lost:
            self._pump()  # finds out whether the server is still there: SDL would wait for its answer for ever
        window, self._window, self._closed = self._window, None, True
        if self._connection.lost:
            return
        if window:
            self._sdl.SDL_DestroyWindow(window)
        self._sdl.SDL_QuitSubSystem(self._sdl.SDL_INIT_VIDEO)
        if not self._sdl.SDL_WasInit(self._sdl.SDL_INIT_VIDEO):
            x_guard.forget(self._display)

    def _guard(self) -> None:
        about = self._sdl.syswm.SDL_SysWMinfo()
        self._sdl.SDL_GetVersion(ctypes.byref(about.version))
        if not self._sdl.syswm.SDL_GetWindowWMInfo(self._window, ctypes.byref(about)):
            raise self._failed("the panel's window does not say which connection it has")
        self._display = int(about.info.x11.display)
        self._connection = x_guard.guard(self._display)

    def _wait_until_placed(self) -> None:
        """Wait until the window covers its monitor, since a window manager may take its time, or have its own mind."""
        wanted = (self.place.x, self.place.y, self.place.width, self.place.height)
        deadline = time.monotonic() + PATIENCE_S
        while (found := self._rectangle()) != wanted:
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"the panel's window lies at {_said(found)}; monitor {self.place.name} lies at {_said(wanted)}.",
                    why="The pattern would be on another monitor, or cut.",
                    fix="Set every monitor's scale to 100 % and end programs that move windows.",
                    measured=list(found),
                    limit=list(wanted),
                    code="window-misplaced",
                )
            self._pump()
            self._require_connected()
            time.sleep(0.01)

    def _rectangle(self) -> tuple[int, int, int, int]:
        x, y, width, height = (ctypes.c_int() for _ in range(4))
        self._sdl.SDL_GetWindowPosition(self._window, ctypes.byref(x), ctypes.byref(y))
        self._sdl.SDL_GetWindowSize(self._window, ctypes.byref(width), ctypes.byref(height))
        return x.value, y.value, width.value, height.value

    def _pixels(self, surface: ctypes.Structure) -> NDArray[np.uint32]:
        layout = surface.format.contents
        masks = (layout.Rmask, layout.Gmask, layout.Bmask)
        size = (surface.w, surface.h)
        if size != (self.place.width, self.place.height) or self._rectangle()[:2] != (self.place.x, self.place.y):
            raise DeviceError(
                f"monitor {self.place.name} changed: the window is now {size[0]} x {size[1]} at "
                f"{self._rectangle()[:2]}, and was {self.place.width} x {self.place.height} at "
                f"{(self.place.x, self.place.y)}.",
                fix="Put the monitor's mode and place back; then `holocal resume`.",
                measured=list(size),
                limit=[self.place.width, self.place.height],
                code="monitor-changed",
            )
        if layout.BytesPerPixel != 4 or masks != (RED, GREEN, BLUE):
            raise DeviceError(
                f"the display has {layout.BitsPerPixel} bits per pixel with red {masks[0]:#x}.",
                why="A level needs 8 bits of its own in each channel.",
                fix="Set the screen's depth to 24 bits.",
                measured=layout.BitsPerPixel,
                limit=32,
                code="screen-depth",
            )
        rows = np.ctypeslib.as_array(
            ctypes.cast(surface.pixels, ctypes.POINTER(ctypes.c_uint32)), (surface.h, surface.pitch // 4)
        )
        return rows[:, : surface.w]

    def _pump(self) -> None:
        """Take what the display server sent; none of it changes what is shown (a request to close is not followed)."""
        event = self._sdl.SDL_Event()
        while not self._connection.lost and self._sdl.SDL_PollEvent(ctypes.byref(event)):
            pass

    def _require_open(self) -> None:
        self._require_thread()
        if not self._window:
            raise DeviceError("the panel's window is closed.", fix="Open the rig again.", code="closed")
        self._require_connected()

    def _require_thread(self) -> None:
        if threading.get_ident() != self._thread:
            raise DeviceError(
                "the panel was called from another thread than the one that opened it.",
                why="SDL allows one thread.",
                fix="Open and use the rig in one thread.",
                code="wrong-thread",
            )

    def _require_connected(self) -> None:
        if self._connection.lost:
            raise DeviceError(
                f"the display server of monitor {self.place.name} is gone.",
                why="Nothing is on the panel any more.",
                fix="Start the desktop session again; then `holocal resume`.",
                code="display-lost",
            )

    def _failed(self, what: str) -> DeviceError:
        said = self._sdl.SDL_GetError().decode(errors="replace") or "no reason given"
        return DeviceError(f"{what}: {said}.", fix="Check the display.", code="window")


def _said(rectangle: tuple[int, int, int, int]) -> str:
    return "{2} x {3} at ({0}, {1})".format(*rectangle)
