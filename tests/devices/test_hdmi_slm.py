"""The panel on a monitor output, on X servers that run here: what is shown is what was sent, and faults are found."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mss
import numpy as np
import pytest
from numpy.typing import NDArray
from test_display_state import edid_bytes
from x_server import XServer
from Xlib import X, Xatom, Xcursorfont
from Xlib import display as x_display

from holocal.errors import ConfigError, DeviceError
from holocal.loop.devices import Inspectable, Slm
from rigs.context import DriverContext
from rigs.hdmi_slm import HdmiSlm, discover, open_slm

pytestmark = pytest.mark.loopback

CONTEXT = DriverContext("bench-a", "bench-a.toml", (515e-9,))
PANEL: dict[str, Any] = {"monitor": "DUMMY1", "width": 960, "height": 540, "pitch_um": 8.0, "settle_ms": 0.0}


@contextmanager
def panel(**keys: Any) -> Iterator[HdmiSlm]:
    slm = open_slm({**PANEL, **keys}, CONTEXT)
    try:
        yield slm
    finally:
        slm.close()


def levels_of(seed: int, width: int = 960, height: int = 540) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)


def read_by_another_client(x: int, y: int, width: int, height: int) -> NDArray[np.uint8]:
    """Return (height, width, 3) red, green, blue as python-xlib reads them: another library, another connection."""
    display = x_display.Display()
    try:
        image = display.screen().root.get_image(x, y, width, height, X.ZPixmap, 0xFFFFFFFF)
        return np.frombuffer(image.data, np.uint8).reshape(height, width, 4)[..., 2::-1]
    finally:
        display.close()


@pytest.mark.parametrize("packing", ["red", "grey"])
def test_sixty_random_patterns_come_back_pixel_by_pixel(x_server: XServer, packing: str) -> None:
    times = []
    with panel(packing=packing) as slm:
        for seed in range(60):
            levels = levels_of(seed)
            began = time.perf_counter()
            shown = slm.show(levels)
            times.append(time.perf_counter() - began)
            assert shown.read_back_ok is True
            assert shown.sha256 == hashlib.sha256(levels.tobytes()).hexdigest()
            if seed % 20 == 0:
                seen = read_by_another_client(1920, 0, 960, 540)
                others = levels if packing == "grey" else np.zeros_like(levels)
                assert np.array_equal(seen, np.stack([levels, others, others], axis=-1))
    print(f"960 x 540, {packing}: {1e3 * np.median(times):.1f} ms per show with its read-back")  # noqa: T201 - no limit


@pytest.mark.parametrize("packing", ["red", "grey"])
def test_a_panel_of_3840_x_2160_shows_what_it_is_sent(x_server: XServer, packing: str) -> None:
    x_server.set_panel(3840, 2160)
    times = []
    with panel(width=3840, height=2160, pitch_um=3.74, packing=packing) as slm:
        for seed in range(4):
            levels = levels_of(seed, 3840, 2160)
            began = time.perf_counter()
            assert slm.show(levels).read_back_ok is True
            times.append(time.perf_counter() - began)
    print(f"3840 x 2160, {packing}: {1e3 * np.median(times):.1f} ms per show with its read-back")  # noqa: T201 - no limit


def test_one_screen_without_root_shows_what_it_is_sent(xvfb_server: XServer) -> None:
    (only,) = discover()
    with panel(monitor=only.name) as slm:
        assert all(slm.show(levels_of(seed)).read_back_ok is True for seed in range(10))
        unknown = {finding.title: finding.ok for finding in slm.inspect()}
        assert unknown["panel output: gamma ramp: distance from a straight one"] is None  # its ramp means nothing


def test_the_pattern_is_on_the_panel_and_nothing_on_the_operators_monitor(x_server: XServer) -> None:
    with panel() as slm:
        slm.show(np.full((540, 960), 255, np.uint8))
        assert read_by_another_client(1920, 0, 960, 540)[..., 0].min() == 255
        assert read_by_another_client(0, 0, 1920, 1080).max() == 0


def test_blank_is_level_0_and_may_be_called_twice_and_after_close(x_server: XServer) -> None:
    slm = open_slm(PANEL, CONTEXT)
    slm.show(levels_of(1))
    slm.blank()
    slm.blank()
    assert read_by_another_client(1920, 0, 960, 540).max() == 0
    slm.show(levels_of(2))
    slm.close()
    slm.close()
    slm.blank()
    assert read_by_another_client(1920, 0, 960, 540).max() == 0
    with pytest.raises(DeviceError, match="closed"):
        slm.show(levels_of(3))


def test_it_plays_the_loops_roles(x_server: XServer) -> None:
    with panel(serial="0417", vendor="lab", model="8M") as slm:
        assert isinstance(slm, Slm)
        assert isinstance(slm, Inspectable)
        facts = slm.describe()
        assert (facts.width, facts.height, facts.pitch_m, facts.bits) == (960, 540, pytest.approx(8e-6), 8)
        assert (facts.vendor, facts.model, facts.serial) == ("lab", "8M", "0417")


def test_monitors_are_listed_by_name_without_a_window(x_server: XServer) -> None:
    found = {place.name: (place.x, place.y, place.width, place.height) for place in discover()}
    assert found == {"DUMMY0": (0, 0, 1920, 1080), "DUMMY1": (1920, 0, 960, 540)}
    assert discover()[1].refresh_hz == pytest.approx(60.0, abs=0.01)  # xrandr rounds the clock to 1 kHz of 38 MHz


def test_a_monitor_that_is_not_there_is_refused_and_those_that_are_there_are_named(x_server: XServer) -> None:
    with pytest.raises(ConfigError, match=r"DUMMY11.*Did you mean DUMMY1\?.*DUMMY0 \(1920 x 1080\)") as refused:
        open_slm({**PANEL, "monitor": "DUMMY11"}, CONTEXT)
    assert refused.value.limit == ["DUMMY0", "DUMMY1"]


def test_a_panel_of_another_size_than_its_monitor_is_refused_with_both_sizes(x_server: XServer) -> None:
    with pytest.raises(ConfigError, match=r"961 x 540; monitor DUMMY1 shows 960 x 540") as refused:
        open_slm({**PANEL, "width": 961}, CONTEXT)
    assert (refused.value.measured, refused.value.limit) == ([960, 540], [961, 540])


def test_an_unknown_key_is_refused_by_name(x_server: XServer) -> None:
    with pytest.raises(ConfigError, match=r"bench-a\.toml, \[slm\]: unknown key moniter"):
        open_slm({**PANEL, "moniter": "DUMMY1"}, CONTEXT)


def test_levels_of_another_shape_or_beyond_the_panels_bits_are_refused(x_server: XServer) -> None:
    with panel(bits=6) as slm:
        with pytest.raises(DeviceError, match="960 x 540"):
            slm.show(np.zeros((960, 540), np.uint8))
        with pytest.raises(DeviceError, match="level 64 was sent to a panel of 6 bits"):
            slm.show(np.full((540, 960), 64, np.uint8))
        assert slm.show(np.full((540, 960), 63, np.uint8)).read_back_ok is True


def test_a_gamma_ramp_is_found_though_the_read_back_is_exact(x_server: XServer) -> None:
    with panel() as slm:
        assert ramp_of(slm).ok is True
        x_server.xrandr("--output", "DUMMY1", "--gamma", "1.2:1.0:0.8")
        assert slm.show(levels_of(1)).read_back_ok is True
        found = ramp_of(slm)
        assert found.ok is False
        # Of 255 (u - u^g) is largest at u = g^(1 / (1 - g)): for u^(1/0.8) that is 20.9 levels.
        g = 1.25
        u = g ** (1 / (1 - g))
        assert found.measured == pytest.approx(255 * (u - u**g), abs=0.1)  # a tenth: 256 entries miss the peak


def ramp_of(slm: HdmiSlm) -> Any:
    return next(finding for finding in slm.inspect() if "gamma" in finding.title)


def test_a_window_that_covers_some_of_the_panel_is_seen(x_server: XServer) -> None:
    other = x_display.Display()
    with panel() as slm:
        assert slm.show(levels_of(1)).read_back_ok is True
        screen = other.screen()
        window = screen.root.create_window(
            1920 + 900, 500, 4, 3, 0, screen.root_depth, override_redirect=True, background_pixel=screen.white_pixel
        )
        window.map()
        window.raise_window()
        other.sync()
        assert slm.show(levels_of(2)).read_back_ok is False  # 12 pixels of 518400
        window.destroy()
        other.sync()
        assert slm.show(levels_of(3)).read_back_ok is True
    other.close()


def test_losing_the_focus_changes_nothing(x_server: XServer) -> None:
    other = x_display.Display()
    with panel() as slm:
        window = other.screen().root.create_window(10, 10, 100, 100, 0, other.screen().root_depth)
        window.map()
        other.sync()
        window.set_input_focus(X.RevertToParent, X.CurrentTime)
        other.sync()
        assert slm.show(levels_of(1)).read_back_ok is True
        assert slm.show(levels_of(2)).read_back_ok is True
    other.close()


def test_no_cursor_is_drawn_on_the_panel(x_server: XServer) -> None:
    display = x_display.Display()
    root, font = display.screen().root, display.open_font("cursor")
    arrow = font.create_glyph_cursor(font, Xcursorfont.left_ptr, Xcursorfont.left_ptr + 1, (65535,) * 3, (65535,) * 3)
    root.change_attributes(cursor=arrow)
    with panel() as slm, mss.MSS(with_cursor=True) as eye:
        for x, seen in ((960, True), (1920 + 480, False)):
            root.warp_pointer(x, 270)
            display.sync()
            slm.show(np.zeros((540, 960), np.uint8))
            around = eye.grab({"left": x - 20, "top": 250, "width": 40, "height": 40})
            assert any(around.rgb) is seen
    display.close()


def test_no_screen_saver_comes_while_the_panel_is_open(x_server: XServer) -> None:
    display = x_display.Display()
    root = display.screen().root

    def saver_comes() -> bool:
        x_server.run("xset", "s", "1", "s", "reset")
        time.sleep(2.2)  # it is asked for after 1 s without input
        return bool(root.screensaver_query_info().state)

    assert saver_comes()
    with panel() as slm:
        assert not saver_comes()
        (found,) = (finding for finding in slm.inspect() if "screen saver" in finding.title)
        assert (found.ok, found.measured) == (True, "after 1 s, held off")
    x_server.run("xset", "s", "600", "s", "reset")
    display.close()


def test_a_mode_that_changes_under_the_window_is_an_error(x_server: XServer) -> None:
    x_server.set_panel(800, 600)
    x_server.set_panel(960, 540)
    with panel() as slm:
        slm.show(levels_of(1))
        x_server.set_panel(800, 600)
        with pytest.raises(DeviceError):
            deadline = time.monotonic() + 5.0  # the news of the change may come after the next pattern
            while time.monotonic() < deadline:
                assert slm.show(levels_of(2)).read_back_ok is not True


def test_read_back_of_the_first_pattern_only_or_of_none(x_server: XServer) -> None:
    with panel(verify="first") as slm:
        assert [slm.show(levels_of(seed)).read_back_ok for seed in range(3)] == [True, None, None]
    with panel(verify="never") as slm:
        assert slm.show(levels_of(1)).read_back_ok is None


def test_a_pattern_settles_before_show_returns(x_server: XServer) -> None:
    with panel(settle_ms=80.0) as slm:
        began = time.monotonic()
        slm.show(levels_of(1))
        assert time.monotonic() - began >= 0.08


def test_settling_follows_the_refresh_rate_when_the_file_says_nothing(x_server: XServer) -> None:
    with panel(settle_ms=None) as slm:
        began = time.monotonic()
        slm.show(levels_of(1))
        assert time.monotonic() - began >= 4 / 60 + 0.033  # four refreshes and the liquid crystal


def test_another_thread_is_refused(x_server: XServer) -> None:
    errors: list[BaseException] = []

    def show(slm: HdmiSlm) -> None:
        try:
            slm.show(levels_of(1))
        except DeviceError as error:
            errors.append(error)

    with panel() as slm:
        thread = threading.Thread(target=show, args=[slm])
        thread.start()
        thread.join()
    assert "another thread" in str(errors[0])


def test_the_monitors_identity_and_colour_range_are_read_from_its_output(x_server: XServer) -> None:
    display = x_display.Display()
    output = output_of(display, "DUMMY1")
    colours, edid = display.intern_atom("Broadcast RGB"), display.intern_atom("EDID")
    limited = display.intern_atom("Limited 16:235")
    display.xrandr_change_output_property(output, edid, Xatom.INTEGER, 0, (8, edid_bytes("HOL", "LETO-3", "6010-0417")))
    display.xrandr_change_output_property(output, colours, Xatom.ATOM, 0, (32, [limited]))
    display.sync()
    try:
        with panel(model="PLUTO-2") as slm:
            facts = slm.describe()
            found = {finding.title: finding for finding in slm.inspect()}
            assert slm.show(levels_of(1)).read_back_ok is True  # neither is seen by a read-back
    finally:
        for atom in (edid, colours):
            display.xrandr_delete_output_property(output, atom)
        display.sync()
        display.close()
    assert (facts.vendor, facts.model, facts.serial) == ("HOL", "LETO-3", "6010-0417")
    swapped = found["panel output: monitor"]
    assert (swapped.ok, swapped.measured, swapped.limit) == (False, "LETO-3", "PLUTO-2")
    assert found["panel output: Broadcast RGB"].ok is False


def output_of(display: Any, name: str) -> int:
    resources = display.screen().root.xrandr_get_screen_resources()
    names = {display.xrandr_get_output_info(o, resources.config_timestamp).name: o for o in resources.outputs}
    return int(names[name])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # python-xlib leaves its socket open
def test_a_display_that_is_not_there_is_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":9876")
    with pytest.raises(DeviceError, match=":9876"):
        open_slm(PANEL, CONTEXT)
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ConfigError, match="DISPLAY"):
        open_slm(PANEL, CONTEXT)
    assert discover() == ()
