"""The C library's allocator told to give memory back: a 4K calibration peaks at 2.9 instead of 3.4 GiB."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress

# glibc's mallopt: blocks from this size on are mapped and returned to the system when freed (its own threshold grows to
# 32 MB, and patches' arrays of 8 MB then stay in the heap), and threads share two heaps instead of sixteen.
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8
_MAPPED_BYTES, _ARENAS = 4_000_000, 2


def return_freed_memory() -> bool:
    """Set the allocator of this process; return whether there was one that listens (glibc's on Linux)."""
    if not sys.platform.startswith("linux"):
        return False
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL("libc.so.6")
        return bool(library.mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES) and library.mallopt(_M_ARENA_MAX, _ARENAS))
    return False
