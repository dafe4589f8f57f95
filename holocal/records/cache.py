"""Arrays kept on disk between programs: what takes a second to make and depends on nothing but its key.

Under ``HOLOCAL_CACHE`` (default: the user's cache directory). Everything in it can be thrown away at any time; a file
that is damaged, or a directory that cannot be written, costs time and nothing else.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_FILES = 256  # 20 to 200 kB each


def cache_directory() -> Path:
    """Return where cached arrays live."""
    chosen = os.environ.get("HOLOCAL_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "holocal"


@dataclass(frozen=True)
class ArrayCache:
    """Named float64 arrays by key, one ``.npz`` file each; the oldest are removed beyond `MOST_FILES`."""

    directory: Path = field(default_factory=cache_directory)

    def get(self, key: str) -> dict[str, NDArray[np.float64]] | None:
        """Return the arrays of a key, or None where there is no whole file of it."""
        try:
            with self._path(key).open("rb") as file, np.load(file, allow_pickle=False) as kept:
                return {name: np.asarray(kept[name], np.float64) for name in kept.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def put(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays under a key; nothing happens where that cannot be done."""
        path = self._path(key)
        temporary = path.with_name(f".{key}.{os.getpid()}.npz")
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            with temporary.open("wb") as file:
                np.savez(file, allow_pickle=False, **dict(arrays))
            temporary.replace(path)
            self._prune()
        except OSError:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)

    def _path(self, key: str) -> Path:
        return self.directory / f"{key}.npz"

    def _prune(self) -> None:
        files = sorted(self.directory.glob("*.npz"), key=lambda path: path.stat().st_mtime)
        for path in files[:-MOST_FILES]:
            path.unlink(missing_ok=True)
