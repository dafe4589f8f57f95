"""Lights: lasers over SCPI, on a socket and on a serial port, and a laser that is switched by hand."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Iterator

import pytest

from holocal.errors import ConfigError, DeviceError, RefusedError, SafetyStop
from holocal.loop.devices import Inspectable, Light
from rigs import scpi_laser
from rigs.bench.lasers import Laser, LaserServer
from rigs.context import DriverContext
from rigs.manual_light import open_light as open_manual
from rigs.scpi_light import ScpiLight, open_light

CONTEXT = DriverContext("bench-a", "bench-a.toml", (473e-9, 515e-9))


@pytest.fixture
def server() -> Iterator[LaserServer]:
    with LaserServer([Laser(473, 0.005, "B1"), Laser(515, 0.010, "G1"), Laser(639, 0.020, "R1")]) as running:
        yield running


def table(server: LaserServer, **keys: object) -> dict[str, object]:
    lines = [
        {"wavelength_nm": laser.wavelength_nm, "url": url, "settle_s": 0.0} | keys
        for laser, url in zip(server.lasers, server.urls, strict=True)
    ]
    return {"driver": "scpi", "lines": lines}


@pytest.fixture
def light(server: LaserServer) -> Iterator[ScpiLight]:
    opened = open_light(table(server), CONTEXT)
    yield opened
    opened.close()
    opened.close()


def test_the_chosen_line_alone_is_on_and_off_is_off_twice(server, light):
    assert isinstance(light, Light) and isinstance(light, Inspectable)
    light.select(515.4e-9)
    assert [laser.on for laser in server.lasers] == [False] * 3
    light.on()
    assert [laser.on for laser in server.lasers] == [False, True, False]
    light.select(639e-9)  # while it is on: it changes over
    assert [laser.on for laser in server.lasers] == [False, False, True]
    light.off()
    light.off()
    assert [laser.on for laser in server.lasers] == [False] * 3
    with pytest.raises(ConfigError, match="no laser line at 532 nm"):
        light.select(532e-9)


def test_emission_is_switched_off_when_the_lasers_are_opened(server):
    server.lasers[1].on = True  # as a program that crashed left it
    open_light(table(server), CONTEXT).close()
    assert not server.lasers[1].on


def test_no_power_level_is_ever_sent(server, light):
    light.on()
    light.inspect()
    light.off()
    sent = [command.strip() for laser in server.lasers for command in laser.log]
    assert any("AMPLitude?" in command for command in sent)
    assert [command for command in sent if "POWer" in command and not command.endswith("?")] == []


def test_a_laser_set_above_its_limit_is_refused_before_the_light_goes_on(server):
    with pytest.raises(RefusedError, match=r"set to 20 mW; light\.lines\.max_power_mw allows 15 mW") as caught:
        open_light(table(server, max_power_mw=15.0), CONTEXT)
    assert caught.value.measured == pytest.approx(20.0)
    assert "SOURce:AM:STATe ON" not in [command.strip() for laser in server.lasers for command in laser.log]


def test_a_laser_turned_up_while_it_is_dark_is_refused_and_one_that_gives_more_is_switched_off(server):
    light = open_light(table(server, max_power_mw=25.0), CONTEXT)
    green = server.lasers[1]
    light.select(515e-9)
    green.power_w = 0.030  # by hand, during the run
    with pytest.raises(RefusedError, match="30 mW"):
        light.on()
    green.power_w, answer = 0.010, green.answer
    green.answer = lambda text: "0.031\r\nOK\r\n" if text.startswith("SOURce:POWer:LEVel?") else answer(text)  # type: ignore[method-assign]
    with pytest.raises(SafetyStop, match="gave 31 mW") as caught:
        light.on()
    assert not green.on and caught.value.exit_status == 5
    light.close()


def test_what_the_operator_set_is_reported(server, light):
    found = light.inspect()
    assert [finding.measured for finding in found] == [5.0, 10.0, 20.0]
    assert all(finding.ok is None and finding.unit == "mW" for finding in found)
    limited = open_light(table(server, max_power_mw=25.0), CONTEXT)
    assert [finding.ok for finding in limited.inspect()] == [True] * 3
    assert limited.identity() == {"serials": ["B1", "G1", "R1"]}
    limited.close()


def test_two_lasers_that_are_swapped_are_refused(server):
    urls = server.urls
    lines = [{"wavelength_nm": 473, "url": urls[1]}, {"wavelength_nm": 515, "url": urls[0]}]
    with pytest.raises(RefusedError, match="emits at 515 nm"):
        open_light({"lines": lines}, CONTEXT)


def test_a_laser_held_dark_by_its_interlock_is_a_device_error(server, light, monkeypatch):
    monkeypatch.setattr(scpi_laser, "EMISSION_S", 0.1)
    light.select(515e-9)
    green = server.lasers[1]
    answer = green.answer
    green.answer = lambda text: "0.0\r\nOK\r\n" if text.startswith("SOURce:POWer:LEVel?") else answer(text)  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"gives 0 mW after 0\.1 s; it is set to 10 mW"):
        light.on()
    assert not green.on
    green.answer = lambda text: "ON\r\nOK\r\n" if text.startswith("SOURce:AM:STATe?") else answer(text)  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="switched OFF and says ON"):
        light.off()


def test_a_laser_that_is_lost_is_a_device_error_and_the_others_are_still_switched_off(server, light, monkeypatch):
    monkeypatch.setattr(scpi_laser, "ANSWER_S", 0.2)
    light.lasers[0]._port.timeout = 0.2
    light.select(515e-9)
    light.on()
    server.lasers[0].answer = lambda text: ""  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"did not answer SOURce:AM:STATe OFF") as caught:
        light.off()
    assert not server.lasers[1].on and caught.value.exit_status == 6


def test_a_socket_is_closed_though_the_laser_at_its_other_end_is_gone(server, light):
    server.close()
    sockets = [laser._port._socket for laser in light.lasers]
    with pytest.raises(DeviceError):
        light.off()
    light.close()
    assert [socket.fileno() for socket in sockets] == [-1] * 3


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "light.lines"),
        ([{"wavelength_nm": 515, "url": "socket://127.0.0.1:1", "power_mw": 3}], "unknown key light.lines"),
        ([{"wavelength_nm": 515, "url": "a"}, {"wavelength_nm": 473, "url": "a"}], "the same url"),
        ([{"wavelength_nm": 515, "url": "socket://127.0.0.1:1"}], "no laser line at 473 nm"),
        ([{"wavelength_nm": 473, "url": "pigeon://x"}, {"wavelength_nm": 515, "url": "b"}], "pigeon"),
    ],
)
def test_an_impossible_table_is_refused_naming_the_key(lines, said):
    with pytest.raises(ConfigError) as caught:
        open_light({"lines": lines}, CONTEXT)
    assert said in str(caught.value)


def test_a_port_that_is_not_there_is_a_device_error(tmp_path):
    lines = [{"wavelength_nm": line, "url": str(tmp_path / f"tty{line}")} for line in (473, 515)]
    with pytest.raises(DeviceError, match="tty473 cannot be opened"):
        open_light({"lines": lines}, CONTEXT)


def test_a_laser_on_a_serial_port_answers_the_same_way():
    """A pseudo-terminal is a serial port to the driver: baud rate, raw mode and exclusive use included."""
    ends = os.openpty()
    for end in ends:
        tty.setraw(end)
    laser = Laser(515, 0.010, "G1")

    def serve() -> None:
        waiting = b""
        while chunk := os.read(ends[0], 256):
            *lines, waiting = (waiting + chunk).split(b"\n")
            if b"bye" in lines:
                return
            for line in lines:
                os.write(ends[0], laser.answer(line.decode()).encode())

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    light = open_light(
        {"lines": [{"wavelength_nm": 515, "url": os.ttyname(ends[1]), "settle_s": 0.0}]},
        DriverContext("bench-a", "bench-a.toml", (515e-9,)),
    )
    light.on()
    assert laser.on
    light.off()
    assert not laser.on
    light.lasers[0]._port.write(b"bye\n")
    thread.join(5)
    light.close()
    for end in ends:
        os.close(end)


def test_a_light_switched_by_hand_knows_its_line_and_says_that_it_cannot_darken():
    light = open_manual({"driver": "manual", "wavelength_nm": 515.0}, CONTEXT)
    assert isinstance(light, Light)
    light.select(515.5e-9)
    light.on()
    light.off()
    with pytest.raises(ConfigError, match=r"light\.wavelength_nm=639"):
        light.select(639e-9)
    (finding,) = light.inspect()
    assert finding.ok is None and "shutter" in finding.remedy
    with pytest.raises(ConfigError, match=r"unknown key light\.power_mw"):
        open_manual({"wavelength_nm": 515.0, "power_mw": 1.0}, CONTEXT)
