"""What of an output's set-up is a fault, and what is only unknown: no display is needed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigs.display_state import edid_finding, findings, ramp_error
from rigs.hdmi.edid import Edid, read_edid
from rigs.hdmi.window import Place
from rigs.hdmi.x_outputs import Output, Saver

RAMP = np.tile(np.arange(256, dtype=np.uint16) * 257, (3, 1))
GOOD = Output(
    place=Place("HDMI-1", 1920, 0, 1920, 1080, 60.0),
    mode=(1920, 1080),
    preferred=(1920, 1080),
    interlaced=False,
    rotation=1,
    ramp=RAMP,
    properties={"Broadcast RGB": "Full", "max bpc": "8", "non-desktop": "0"},
    edid=None,
    virtual=False,
)
OFF = Saver(0, 0, powered=True)


def edid_bytes(vendor: str, model: str, serial: str) -> bytes:
    """Return an EDID as VESA's E-EDID 1.4 lays it out: header, maker, product 0x0102, number 7, two texts, checksum."""
    block = bytearray(128)
    block[:8] = bytes.fromhex("00ffffffffffff00")
    packed = sum((ord(letter) - 64) << shift for letter, shift in zip(vendor, (10, 5, 0), strict=True))
    block[8:10] = packed.to_bytes(2, "big")
    block[10:12], block[12:16] = bytes([2, 1]), bytes([7, 0, 0, 0])
    for at, kind, text in ((72, 0xFC, model), (90, 0xFF, serial)):
        block[at : at + 5] = bytes([0, 0, 0, kind, 0])
        block[at + 5 : at + 18] = (text.encode() + b"\n").ljust(13)
    block[127] = -sum(block) % 256
    return bytes(block)


def verdicts(
    output: Output, saver: Saver = OFF, *, composited: bool = False, held: bool = False
) -> dict[str, bool | None]:
    found = findings(output, saver, composited=composited, held=held)
    return {finding.title.removeprefix("panel output: "): finding.ok for finding in found}


def test_a_panel_set_up_as_it_should_be_passes_everything() -> None:
    assert set(verdicts(GOOD).values()) == {True}


@pytest.mark.parametrize(
    ("fault", "title"),
    [
        ({"rotation": 2}, "rotation"),
        ({"rotation": 4}, "rotation"),
        ({"rotation": 1 | 16}, "rotation"),  # mirrored
        ({"interlaced": True}, "refresh rate"),
        ({"place": Place("HDMI-1", 0, 0, 3840, 2160, 60.0)}, "scale of the desktop"),
        ({"properties": {"Broadcast RGB": "Limited 16:235"}}, "Broadcast RGB"),
        ({"properties": {"max bpc": "6"}}, "max bpc"),
        ({"properties": {"dithering": "on"}}, "dithering"),
        ({"ramp": RAMP[:, ::-1]}, "gamma ramp: distance from a straight one"),
    ],
)
def test_each_fault_fails_its_own_line_and_no_other(fault: dict[str, object], title: str) -> None:
    found = verdicts(replace(GOOD, **fault))  # type: ignore[arg-type]
    assert [line for line, ok in found.items() if ok is not True] == [title]
    assert found[title] is False


def test_what_cannot_be_known_is_unknown_and_not_failed() -> None:
    assert verdicts(replace(GOOD, virtual=True, ramp=RAMP * 0))["gamma ramp: distance from a straight one"] is None
    assert verdicts(replace(GOOD, ramp=RAMP[:, :0]))["gamma ramp: distance from a straight one"] is None
    assert verdicts(replace(GOOD, properties={"Broadcast RGB": "Automatic"}))["Broadcast RGB"] is None
    assert verdicts(replace(GOOD, preferred=(1280, 720)))["mode"] is None
    assert verdicts(GOOD, composited=True)["compositor"] is None


def test_a_screen_saver_fails_unless_it_is_held_off_and_a_monitor_that_is_off_always() -> None:
    title = "screen saver and power saving"
    assert verdicts(GOOD, Saver(600, 0, powered=True))[title] is False
    assert verdicts(GOOD, Saver(0, 900, powered=True))[title] is False
    assert verdicts(GOOD, Saver(600, 900, powered=True), held=True)[title] is True
    assert verdicts(GOOD, Saver(0, 0, powered=False), held=True)[title] is False


@pytest.mark.parametrize("entries", [256, 1024, 4096])
def test_a_straight_ramp_is_straight_whatever_its_length(entries: int) -> None:
    ramp = np.tile(np.round(np.linspace(0, 65535, entries)).astype(np.uint16), (3, 1))
    assert ramp_error(ramp) < 0.01  # 16 bits round to 1/514 of a level


def test_both_usual_ways_of_writing_a_straight_ramp_pass_and_a_gamma_of_1_percent_does_not() -> None:
    shifted = np.tile(np.arange(256, dtype=np.uint16) << 8, (3, 1))
    assert ramp_error(shifted) == 0.0
    bent = RAMP.copy()
    bent[1] = np.round(65535 * np.linspace(0, 1, 256) ** (1 / 1.01))
    assert ramp_error(bent) == pytest.approx(255 * 0.01 / np.e, rel=0.02)  # u ln u is -1/e at most; next order 1 %
    assert verdicts(replace(GOOD, ramp=shifted))["gamma ramp: distance from a straight one"] is True
    assert verdicts(replace(GOOD, ramp=bent))["gamma ramp: distance from a straight one"] is False


def test_an_edid_says_who_made_the_monitor() -> None:
    assert read_edid(edid_bytes("HOL", "LETO-3", "6010-0417")) == Edid("HOL", "LETO-3", "6010-0417")
    plain = bytearray(edid_bytes("HOL", "", ""))
    plain[72:108] = bytes(36)
    plain[127] = 0
    plain[127] = -sum(plain) % 256
    assert read_edid(bytes(plain)) == Edid("HOL", "0x0102", "7")  # no texts: product code and number


def test_a_damaged_edid_is_none() -> None:
    good = edid_bytes("HOL", "LETO-3", "1")
    assert read_edid(good[:127]) is None
    assert read_edid(good[:20] + bytes([good[20] ^ 1]) + good[21:]) is None
    assert read_edid(b"") is None


def test_two_panels_whose_cables_are_swapped_are_told_apart() -> None:
    here = Edid("HOL", "LETO-3", "0418")
    (swapped,) = edid_finding(Edid("", "LETO-3", "0417"), here)
    assert (swapped.ok, swapped.measured, swapped.limit) == (False, "LETO-3 0418", "LETO-3 0417")
    (right,) = edid_finding(Edid("", "", "0418"), here)
    assert right.ok is True
    assert edid_finding(Edid("", "", ""), here) == ()
    assert edid_finding(Edid("", "", "0418"), None) == ()
