"""An append-only file of finished pieces of work, one whole line each: what a killed program has done is not lost.

A line is ``{"key": ..., "value": ..., "check": ...}``, `check` being the first hexadecimal digits of the SHA-256 of key
and value. A line that was cut off, or does not fit its check, ends the file: it and what follows is done again.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from holocal.records.files import dump_json, storage_error, write_bytes

DIGITS = 12


class Journal:
    """The journal at `path`, which need not exist yet."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[str, Any]:
        """Return the values of all whole lines by their keys, after cutting off what is not whole."""
        if not self.path.is_file():
            return {}
        data = self.path.read_bytes()
        found: dict[str, Any] = {}
        kept = 0
        for line in data.splitlines(keepends=True):
            piece = _whole(line)
            if piece is None:
                break
            found[piece[0]] = piece[1]
            kept += len(line)
        if kept < len(data):
            write_bytes(self.path, data[:kept])
        return found

    def add(self, key: str, value: Any) -> Any:
        """Write a piece and have it reach the disk; return its value as a later reader will have it."""
        body = dump_json(value, indent=None)
        line = f'{{"key": {json.dumps(key)}, "value": {body}, "check": "{_check(key, body)}"}}\n'
        try:
            with self.path.open("ab") as file:
                file.write(line.encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise storage_error(error, self.path) from error
        return json.loads(body)


def _whole(line: bytes) -> tuple[str, Any] | None:
    """Return key and value of a line; None where it is not what was written."""
    if not line.endswith(b"\n"):
        return None
    try:
        piece = json.loads(line)
        key, value, check = piece["key"], piece["value"], piece["check"]
    except (ValueError, KeyError, TypeError):
        return None
    return (key, value) if check == _check(key, dump_json(value, indent=None)) else None


def _check(key: str, body: str) -> str:
    return hashlib.sha256(f"{key}\n{body}".encode()).hexdigest()[:DIGITS]
