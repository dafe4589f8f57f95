"""Who made a monitor: the 128 bytes that it sends over its cable (VESA E-EDID 1.4, section 3)."""

from __future__ import annotations

from dataclasses import dataclass

HEADER = bytes([0, 255, 255, 255, 255, 255, 255, 0])
BLOCK = 128
DESCRIPTORS = (54, 72, 90, 108)  # where the four 18-byte descriptors begin
SERIAL_TEXT, NAME_TEXT = 0xFF, 0xFC  # their kinds


@dataclass(frozen=True)
class Edid:
    """A monitor's maker (three letters), model and serial number; "" where it does not say."""

    vendor: str
    model: str
    serial: str


def read_edid(data: bytes) -> Edid | None:
    """Return what a monitor says of itself, or None when the bytes are no EDID (cut short, or a wrong checksum)."""
    block = data[:BLOCK]
    if len(block) < BLOCK or block[:8] != HEADER or sum(block) % 256:
        return None
    maker = int.from_bytes(block[8:10], "big")
    vendor = "".join(chr(ord("A") - 1 + (maker >> shift & 31)) for shift in (10, 5, 0))
    product, number = int.from_bytes(block[10:12], "little"), int.from_bytes(block[12:16], "little")
    texts = {block[at + 3]: _text(block[at + 5 : at + 18]) for at in DESCRIPTORS if block[at : at + 3] == b"\0\0\0"}
    return Edid(
        vendor if vendor.isalpha() else "",
        texts.get(NAME_TEXT) or f"0x{product:04x}",
        texts.get(SERIAL_TEXT) or (str(number) if number else ""),
    )


def _text(raw: bytes) -> str:
    """Return a descriptor's text: code page 437, ended by a line feed, filled up with spaces."""
    return raw.split(b"\n")[0].decode("cp437").strip()
