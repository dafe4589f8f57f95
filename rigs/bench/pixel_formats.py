"""Counts as a GigE Vision camera puts them on the wire: the Pixel Format Naming Convention, and its two packings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PixelFormat:
    """A monochrome format: its PFNC code, its bits, and how they are packed ("", "p" bit by bit, "Packed" by pairs)."""

    name: str
    code: int
    bits: int
    packing: str = ""

    def packed(self, counts: NDArray[np.uint16]) -> bytes:
        """Return (height, width) counts as the bytes of an image."""
        if self.bits == 8:
            return counts.astype(np.uint8).tobytes()
        if self.packing == "":
            return counts.astype("<u2").tobytes()
        if self.packing == "p":  # the low bits first, without gaps, across the ends of rows
            bits = (counts.reshape(-1, 1) >> np.arange(self.bits, dtype=np.uint16)) & 1
            return np.packbits(bits.astype(np.uint8).ravel(), bitorder="little").tobytes()
        first, second = counts.ravel()[::2], counts.ravel()[1::2]  # two pixels in three bytes, low bits in the middle
        low = 2 ** (self.bits - 8) - 1
        middle = (first & low) | ((second & low) << 4)
        triples = np.stack([first >> (self.bits - 8), middle, second >> (self.bits - 8)], axis=1)
        return triples.astype(np.uint8).tobytes()


# Codes of the PFNC 2.x value list; bits 16 to 23 are the size of a pixel on the wire.
FORMATS = (
    PixelFormat("Mono8", 0x01080001, 8),
    PixelFormat("Mono10", 0x01100003, 10),
    PixelFormat("Mono10p", 0x010A0046, 10, "p"),
    PixelFormat("Mono10Packed", 0x010C0004, 10, "Packed"),
    PixelFormat("Mono12", 0x01100005, 12),
    PixelFormat("Mono12p", 0x010C0047, 12, "p"),
    PixelFormat("Mono12Packed", 0x010C0006, 12, "Packed"),
    PixelFormat("Mono14", 0x01100025, 14),
    PixelFormat("Mono16", 0x01100007, 16),
)
BY_CODE = {form.code: form for form in FORMATS}
