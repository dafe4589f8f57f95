"""The checks that were made of a rig's accepted calibration: a JSON file each, beside the calibration."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from holocal.errors import HolocalError
from holocal.records.calibration import rig_directory
from holocal.records.files import make_directory, read_json, write_json
from holocal.records.run_files import RUN_TIME, begun


def keep_check(rig: str, said: Mapping[str, Any], time: datetime) -> None:
    """Write a check of a rig, made at `time` (UTC)."""
    write_json(
        make_directory(_directory(rig)) / f"{time.strftime(RUN_TIME)}-check-{secrets.token_hex(2)}.json", dict(said)
    )


def checks_of(rig: str) -> list[dict[str, Any]]:
    """Return the checks of a rig, oldest first; a damaged file is left out."""
    found = []
    for path in sorted(_directory(rig).glob("*-check-*.json")):
        time = begun(path.name)
        if time is None or path.is_symlink():
            continue
        try:
            said = read_json(path)
        except HolocalError:
            continue
        checked = said.get("checked")
        if isinstance(checked, list) and all(isinstance(one, dict) for one in checked):
            found.append({**said, "utc": time.strftime("%Y-%m-%dT%H:%M:%SZ")})
    return found


def _directory(rig: str) -> Path:
    return rig_directory(rig) / "checks"
