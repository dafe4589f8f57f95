"""What happens on every way out: the light off, the panel blank, the devices let go, whatever else has failed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from holocal.errors import DeviceError, HolocalError
from holocal.loop.devices import Rig
from holocal.loop.signals import shielded

LOGGER = logging.getLogger("holocal.loop")


@contextmanager
def dark_at_the_end(rig: Rig) -> Iterator[None]:
    """Switch the light off and blank the panel on every way out, each though the other may fail.

    Raises
    ------
    DeviceError
        The light could not be switched off, whatever else ended the run: somebody has to do it by hand. Or the panel
        could not be blanked and nothing else is wrong; beside another error that is only logged: the light is off.
    """
    try:
        yield
    except BaseException as error:
        _make_dark(rig, error)
        raise
    _make_dark(rig, None)


def _make_dark(rig: Rig, ended_by: BaseException | None) -> None:
    with shielded():
        light, panel = _failure(rig.light.off), _failure(rig.slm.blank)
    if panel is not None:
        LOGGER.error("the panel could not be blanked: %s", panel)
    if light is not None:
        before = "" if ended_by is None else f" Before that: {str(ended_by) or type(ended_by).__name__}"
        raise DeviceError(
            f"the light could not be switched off: {light}.{before}",
            why="It may still be on.",
            fix="Switch it off by hand now; then check its cable.",
            code="light-not-off",
        ) from (ended_by or light)
    if panel is not None and ended_by is None:
        raise DeviceError(
            f"the panel could not be blanked: {panel}.",
            why="It still shows its last pattern; the light is off.",
            fix="Check its cable and power; then `holocal resume`.",
            code="panel-not-blank",
        ) from panel


def close_quietly(close: Callable[[], None], what: str) -> None:
    """Call `close`; a failure is logged, since what follows must be closed too and an error may be on its way."""
    with shielded():
        failure = _failure(close)
    if failure is not None:
        LOGGER.error("%s could not be closed: %s", what, failure)


def _failure(call: Callable[[], None]) -> HolocalError | OSError | None:
    try:
        call()
    except (HolocalError, OSError) as error:
        return error
    except Exception as error:  # noqa: BLE001 - a driver's own errors: the light and the panel come first, then the bug
        return DeviceError(f"{type(error).__name__}: {error}")
    return None
