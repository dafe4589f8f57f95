"""X servers for the tests: one Xorg with the dummy driver for all of them, DISPLAY set for the one that asks."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from x_server import XServer, xorg, xvfb

PANEL = (960, 540)


@pytest.fixture(scope="session")
def xorg_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[XServer]:
    """Xorg with DUMMY0 (1920 x 1080) and DUMMY1, for the whole session."""
    with xorg(tmp_path_factory.mktemp("xorg"), width=PANEL[0], height=PANEL[1]) as server:
        yield server


@pytest.fixture
def x_server(xorg_server: XServer, monkeypatch: pytest.MonkeyPatch) -> XServer:
    """The session's Xorg as DISPLAY, DUMMY1 in its mode of 960 x 540 with a straight gamma ramp."""
    monkeypatch.setenv("DISPLAY", xorg_server.display)
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    xorg_server.set_panel(*PANEL)
    return xorg_server


@pytest.fixture
def xvfb_server(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[XServer]:
    """Xvfb as DISPLAY: one screen of the panel's size."""
    with xvfb(tmp_path_factory.mktemp("xvfb"), width=PANEL[0], height=PANEL[1]) as server:
        monkeypatch.setenv("DISPLAY", server.display)
        monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
        yield server
