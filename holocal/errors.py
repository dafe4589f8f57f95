"""Every error that holocal raises on purpose, and the exit status each ends with.

HolocalError                      (1)
├── UsageError                    (2)  the command line or a parameter
│   ├── ConfigError               (2)  a rig file or a procedure's parameters: names file and key
│   └── InputError                (2)  an image, a scene, a frame, a run directory
├── SamplingError                 (2)  a wave that the grid cannot hold
├── StorageError                  (2)  a disk that is full, a directory that cannot be written
├── RefusedError                  (4)  pre-flight, another rig's calibration, a stale one
├── SafetyStop                    (5)  light that cannot be made safe for the sensor
├── DeviceError                   (6)  a device lost, silent or wrong
├── BusyError                     (75) the rig is in use by another process
└── Interrupted                   (130) stopped by the operator

SamplingWarning is no error: the result is the best there is, and its doubt is said.
"""

from __future__ import annotations

from typing import Any


class HolocalError(Exception):
    """What happened, why it matters, what to do; with the number and the limit where there is one.

    Parameters
    ----------
    what
        What happened, as a sentence with its number and unit.
    why
        Why that matters, one clause.
    fix
        What to do about it, naming file and key where there are any.
    measured, limit
        The number that was found and the one it was held against, for the JSON form.
    code
        Short stable identifier, for example ``"rig-file"``.
    """

    exit_status = 1
    default_code = "holocal"

    def __init__(
        self,
        what: str,
        *,
        why: str = "",
        fix: str = "",
        measured: Any = None,
        limit: Any = None,
        code: str | None = None,
    ) -> None:
        self.what = what
        self.why = why
        self.fix = fix
        self.measured = measured
        self.limit = limit
        self.code = code or self.default_code
        super().__init__(" ".join(part for part in (what, why, fix) if part))

    def as_json(self) -> dict[str, Any]:
        """Return the error as a JSON-ready dictionary."""
        return {
            "code": self.code,
            "what": self.what,
            "why": self.why,
            "fix": self.fix,
            "measured": self.measured,
            "limit": self.limit,
            "exit_status": self.exit_status,
        }


class UsageError(HolocalError):
    """The command line or a parameter makes no sense."""

    exit_status = 2
    default_code = "usage"


class ConfigError(UsageError):
    """A rig file or a procedure's parameters are wrong; names the file and the key."""

    default_code = "config"


class InputError(UsageError):
    """An image, scene, frame or run directory cannot be used."""

    default_code = "input"


class SamplingError(HolocalError):
    """A wave that the grid cannot hold."""

    exit_status = 2
    default_code = "sampling"


class SamplingWarning(UserWarning):
    """A wave that its samples do not determine."""


class StorageError(HolocalError):
    """A disk that is full or a directory that cannot be written."""

    exit_status = 2
    default_code = "storage"


class RefusedError(HolocalError):
    """Refused before the light went on."""

    exit_status = 4
    default_code = "refused"


class SafetyStop(HolocalError):  # noqa: N818 - a stop, not a mistake
    """Light that cannot be made safe for the sensor."""

    exit_status = 5
    default_code = "safety"


class DeviceError(HolocalError):
    """A device was lost, did not answer in time, or answered wrongly."""

    exit_status = 6
    default_code = "device"


class BusyError(HolocalError):
    """The rig is in use by another process."""

    exit_status = 75
    default_code = "busy"


class Interrupted(HolocalError):  # noqa: N818 - the operator's wish, not a mistake
    """Stopped by the operator; ``holocal resume`` goes on."""

    exit_status = 130
    default_code = "interrupted"
