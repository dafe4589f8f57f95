"""One piece of work to a thread, for pieces too small to be shared among threads each."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Result = TypeVar("Result")


def each(work: Callable[[int], Result], count: int) -> list[Result]:
    """Return the work of each of 0 ... count - 1, in order; while it runs, torch gives each thread one core."""
    threads = torch.get_num_threads()
    if threads == 1 or count < 2:
        return [work(one) for one in range(count)]
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(work, range(count)))
    finally:
        torch.set_num_threads(threads)
