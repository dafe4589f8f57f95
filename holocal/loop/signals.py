"""SIGINT, SIGTERM and SIGHUP while a rig is open: the one place where holocal handles signals.

A command that touches a rig runs inside `interruptible`: any of the three raises `KeyboardInterrupt` in it, so that its
context managers blank the panel and switch the light off. While they do, and while a rig is being opened, `shielded`
holds a signal back, so that it cannot cut that short; a second one while a rig is being opened gets through, since an
opening may hang. A closed loop has `stop_requests` inside: the first signal lets the step finish.

SIGKILL and a power cut cannot be caught: the panel then keeps its pattern and the light stays on until the rig is
opened again, when it is blanked and switched off before anything else. What must go dark without software needs an
interlock.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

NUMBERS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

Handler = Callable[[int, FrameType | None], None]


class StopRequest:
    """Whether the operator, or the system, asked for an end."""

    def __init__(self) -> None:
        self.name: str | None = None

    def __bool__(self) -> bool:
        return self.name is not None


@contextmanager
def _handling(handler: Handler) -> Iterator[None]:
    """Have `handler` called on each of the signals; the handlers before it are put back. Only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # `nohup` ignores SIGHUP, and means it.
    numbers = [n for n in NUMBERS if n == signal.SIGINT or signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def interruptible() -> Iterator[None]:
    """Have each signal raise `KeyboardInterrupt`, so that SIGTERM too leaves by way of every context manager."""
    with _handling(_raise):
        yield


@contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Yield what a first signal sets; a second one raises `KeyboardInterrupt`."""
    request = StopRequest()

    def ask(number: int, _frame: FrameType | None) -> None:
        if request.name is not None:
            raise KeyboardInterrupt
        request.name = signal.Signals(number).name

    with _handling(ask):
        yield request


@contextmanager
def shielded(*, held_back: int | None = None) -> Iterator[StopRequest]:
    """Hold signals back (the first `held_back` of them, None: all) and yield which came, for the caller to act on."""
    request = StopRequest()
    count = 0

    def note(number: int, _frame: FrameType | None) -> None:
        nonlocal count
        count += 1
        request.name = signal.Signals(number).name
        if held_back is not None and count > held_back:
            raise KeyboardInterrupt

    with _handling(note):
        yield request


def _raise(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
