"""One door for work in many pieces: in this process, in several on this machine, or on a Dask cluster.

Every piece is a function of its item alone, so the results are the same wherever and in whatever order they are made;
they come back as they arrive, are written to a journal, and those that the journal has are not made again.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from holocal import __version__
from holocal.errors import ConfigError, DeviceError, RefusedError, UsageError
from holocal.records.journal import Journal

Item = TypeVar("Item")
Result = TypeVar("Result")
Work = Callable[[Item], Result]

CONNECT_S = 15.0  # to wait for a scheduler


@dataclass(frozen=True)
class Farm:
    """Where work is done: `workers` processes here (1: this one), or the workers of a Dask `scheduler`."""

    workers: int = 1
    scheduler: str | None = None

    def __str__(self) -> str:
        if self.scheduler is not None:
            return f"the workers of {self.scheduler}"
        return "one process" if self.workers == 1 else f"{self.workers} processes"


def farm_of(workers: int, scheduler: str | None) -> Farm:
    """Return the farm of a command line; `UsageError` for both at once."""
    if scheduler is not None and workers != 1:
        raise UsageError("--workers and --scheduler exclude each other.", fix="A scheduler has its own workers.")
    return Farm(workers, scheduler)


def gathered(
    work: Work[Item, Result],
    items: Mapping[str, Item],
    farm: Farm,
    journal: Journal,
    said: Callable[[int, int], object] = lambda done, of: None,
    still: Callable[[Any], bool] = lambda value: True,
) -> dict[str, Any]:
    """Return the results of all items by their keys, each as JSON has it, in the order of the items.

    Parameters
    ----------
    work
        A function of an item, at the top of a module, whose result `dump_json` can write.
    items
        Key -> item; both go to other processes, so they are small.
    journal
        Has what is done already, and is told of each result as it arrives.
    said
        Told how many of how many are done, at once and after each.
    still
        Whether a result that the journal has still holds: a file that it names may be gone.
    """
    done = {key: value for key, value in journal.read().items() if key in items and still(value)}
    said(len(done), len(items))
    todo = {key: item for key, item in items.items() if key not in done}
    for key, result in arriving(work, todo, farm):
        done[key] = journal.add(key, result)
        said(len(done), len(items))
    return {key: done[key] for key in items}


def arriving(work: Work[Item, Result], items: Mapping[str, Item], farm: Farm) -> Iterator[tuple[str, Result]]:
    """Yield key and result of every item as it arrives.

    Raises
    ------
    DeviceError
        A worker died; what it had not finished is lost, and made when the work is resumed.
    """
    if farm.scheduler is None and (farm.workers == 1 or len(items) < 2):
        for key, item in items.items():
            yield key, work(item)
        return
    with _executor(farm, len(items)) as executor:
        keys: dict[Future[Result], str] = {executor.submit(work, item): key for key, item in items.items()}
        try:
            for future in as_completed(keys):
                yield keys.pop(future), future.result()
        except (BrokenProcessPool, OSError) as error:
            raise DeviceError(
                f"a worker was lost: {error}.",
                why=f"{len(keys)} pieces are not done.",
                fix="Give it more memory, or fewer workers; then resume.",
                code="worker-lost",
            ) from error
        finally:
            for future in keys:
                future.cancel()


@contextmanager
def _executor(farm: Farm, pieces: int) -> Iterator[Executor]:
    if farm.scheduler is not None:
        with _dask(farm.scheduler) as executor:
            yield executor
        return
    pool = ProcessPoolExecutor(
        min(farm.workers, pieces), mp_context=multiprocessing.get_context("spawn"), initializer=_begin
    )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _dask(scheduler: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError(
            "--scheduler needs Dask, which is not installed.",
            fix='pip install "holocal[dask]", or use --workers N.',
            code="no-dask",
        ) from error
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {scheduler} does not answer: {error}.",
            fix="Start one with `dask scheduler`, and give its address like tcp://host:8786.",
            code="no-scheduler",
        ) from error
    with client:
        _check_workers(client, scheduler)
        yield client.get_executor(pure=False, retries=1)


def _check_workers(client: Any, scheduler: str) -> None:
    """Raise `RefusedError` unless there are workers and all of them have this version of holocal."""
    try:
        versions = set(client.run(version).values())
    except ImportError as error:
        raise RefusedError(
            f"a worker of {scheduler} cannot import holocal: {error}.", fix="Install it there too."
        ) from error
    if versions != {__version__}:
        have = f"have holocal {', '.join(sorted(versions))}" if versions else "are none yet"
        raise RefusedError(
            f"the workers of {scheduler} {have}; this is {__version__}.",
            why="Numbers of two versions must not be mixed.",
            fix="Start workers with `dask worker`, with this version.",
            measured=sorted(versions),
            limit=__version__,
            code="other-version",
        )


def version() -> str:
    """Return the version of holocal of the process that is asked."""
    return __version__


def _begin() -> None:
    """Have a worker leave Ctrl-C to its parent, and end when the parent is gone: killed, it cannot say so itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
