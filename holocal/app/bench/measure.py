"""The unit of the benchmarks, a bare FFT pair of the same size in the same process, and times as multiples of it."""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
import torch

WORKERS = 2


@dataclass(frozen=True)
class Timing:
    """Median seconds of a piece of work, and the median of its ratios to the unit measured next to each run."""

    seconds: float
    ratio: float
    unit_seconds: float
    runs: int

    def row(self) -> dict[str, float]:
        """Return the numbers under their names in the tables."""
        return {"seconds": self.seconds, "ratio_p": self.ratio, "unit_seconds": self.unit_seconds}


@dataclass
class Unit:
    """P: a complex64 FFT and its inverse, rows x columns, two threads, the faster of scipy and torch."""

    rows: int
    columns: int

    def __post_init__(self) -> None:
        noise = np.random.default_rng(0).standard_normal((2, self.rows, self.columns), np.float32)
        self._field = (noise[0] + 1j * noise[1]).astype(np.complex64)
        self._scipy_wins = self._time(self._by_scipy) < self._time(self._by_torch)

    def seconds(self) -> float:
        """Return the time of one pair, now: the median of three."""
        return self._time(self._by_scipy if self._scipy_wins else self._by_torch)

    def _time(self, pair: Callable[[], object]) -> float:
        pair()
        return float(np.median([_timed(pair) for _ in range(3)]))

    def _by_scipy(self) -> None:
        forth = scipy.fft.fft2(self._field, workers=WORKERS)
        scipy.fft.ifft2(forth, workers=WORKERS, overwrite_x=True)

    def _by_torch(self) -> None:
        torch.fft.ifft2(torch.fft.fft2(torch.from_numpy(self._field)))

    def ratio(self, work: Callable[[], object], *, runs: int = 5, warm: bool = True) -> Timing:
        """Return how long `work` takes: `runs` times, the unit measured before each; once more first if `warm`."""
        if warm:
            work()
        units, spent = [], []
        for _ in range(runs):
            units.append(self.seconds())
            spent.append(_timed(work))
        ratios = np.array(spent) / np.array(units)
        return Timing(float(np.median(spent)), float(np.median(ratios)), float(np.median(units)), runs)


def _timed(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def peak_memory_mib() -> float:
    """Return the largest memory that this process has used so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if platform.system() == "Darwin" else 2**10)


def machine() -> dict[str, Any]:
    """Return what a reader must know of the machine: processor, cores, memory, versions, load."""
    info = Path("/proc/cpuinfo")
    names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "load_1min": os.getloadavg()[0],
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
    }
