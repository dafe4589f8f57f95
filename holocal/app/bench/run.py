"""The benchmarks one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from holocal.app.bench import encoding, propagation, synthesis
from holocal.errors import UsageError

Row = dict[str, Any]
Size = tuple[int, int]


def parsed_size(text: str) -> Size:
    """Return (width, height) of a text like 3840x2160."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and 16 <= int(width) <= 16384 and 16 <= int(height) <= 16384):
        raise UsageError(f"--size {text} is no size.", fix="Write it like 3840x2160, 16 to 16384 each.")
    return int(width), int(height)


def rows_of(
    stages: Sequence[str], sizes: Sequence[Size], *, runs: int, device: str, say: Callable[[str], object]
) -> Iterator[Row]:
    """Yield the rows of the stages in their order, telling `say` what is measured."""
    for stage in stages:
        for size in sizes if stage not in ("quality", "camera") else sizes[:1]:
            say(f"{stage} at {size[0]}x{size[1]}")
            yield from _rows(stage, size, runs, device)
    if "propagation" in stages:
        yield from propagation.errors()


def _rows(stage: str, size: Size, runs: int, device: str) -> Iterator[Row]:
    if stage == "synthesis":
        yield from synthesis.methods(*size, runs=runs)
    elif stage == "density":
        yield from synthesis.densities(*size, runs=runs)
    elif stage == "frame":
        synthesis.forget()
        yield encoding.whole_frame(*size, runs=runs)
        if device != "cpu":
            yield encoding.on_device(*size, device, runs=runs)
    elif stage == "encoders":
        yield encoding.one_iteration(*size, runs=runs)
        yield from encoding.on_panel(*size, runs=max(1, runs // 2))
    elif stage == "quality":
        yield from encoding.fourier_quality(images=1, counts=(10, 50))
    elif stage == "camera":
        yield from encoding.bench_quality()
    elif stage == "propagation":
        yield from propagation.times(*size, runs=runs)
