"""Scene to frame, the thesis's pipeline (figure 3.2): points, zones, full-complex hologram, IFTA, levels.

Pure: the same inputs give the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.ifta import Encoded, ifta
from holocal.hologram.frame import panel_phase, phase_to_levels
from holocal.hologram.grid import Grid, panel_grid, resample_compact, synthesis_grid
from holocal.hologram.scenes.image import InitialPhase, PointGrid, RandomPhase, image_points
from holocal.hologram.settings import HologramSettings
from holocal.hologram.synthesis import synthesise
from holocal.hologram.zones import ZonePlan, zone_plan
from holocal.optics.bench import Panel

__all__ = ["HologramSettings", "Rendered", "render_image", "render_images"]

_BLOCK = 128  # rows at a time: float64 work that stays in the cache
_MARGIN_BINS = 2.0  # the window is this much wider than the pupil's image: half a pixel of the footprint's edge


@dataclass(frozen=True)
class Rendered:
    """A frame and how it came about.

    `levels` (H, W) uint8 for the panel; `phase_rad` (H, W) float32 in [0, 2 pi), before quantisation; `field` (H, W)
    complex64, the full-complex hologram before the linear phase and the encoding, or None; `seconds` per stage;
    `skipped` a sentence for each thing left out; `efficiency` the share of the panel's light that is wanted signal in
    the pupil; `signal_error` after each IFTA iteration.
    """

    levels: NDArray[np.uint8]
    phase_rad: NDArray[np.float32]
    field: NDArray[np.complex64] | None
    seconds: dict[str, float]
    skipped: list[str]
    efficiency: float
    signal_error: tuple[float, ...] = ()


def render_image(
    intensity: ArrayLike,
    settings: HologramSettings,
    *,
    seed: int,
    keep_complex: bool = False,
    response_rad: ArrayLike | None = None,
    initial_phase: InitialPhase | None = None,
) -> Rendered:
    """Return the frame that shows an image.

    Parameters
    ----------
    intensity
        (rows, columns), not negative; row 0 on top. Covers `settings.fov_rad`, centred on the gaze.
    settings
        Panel, bench, colour, field, zones, iterations.
    seed
        Of the random initial phase.
    keep_complex
        Keep the full-complex hologram too (66 MB at 4K).
    response_rad
        (256,) phase of each level; default 2 pi L / 256.
    initial_phase
        Another choice of the points' initial phase than `RandomPhase(seed)`.
    """
    choice = initial_phase or RandomPhase(seed)
    scene = image_points(intensity, fov_rad=settings.fov_rad, initial_phase=choice)
    return _render([scene], settings, keep_complex=keep_complex, response_rad=response_rad)[0]


def render_images(
    intensity: ArrayLike,
    settings: HologramSettings,
    *,
    seeds: Sequence[int],
    keep_complex: bool = False,
    response_rad: ArrayLike | None = None,
) -> list[Rendered]:
    """Return one frame per seed of the same image, as `render_image` would; the zones' factors are made once."""
    scenes = [image_points(intensity, fov_rad=settings.fov_rad, initial_phase=RandomPhase(seed)) for seed in seeds]
    return _render(scenes, settings, keep_complex=keep_complex, response_rad=response_rad)


def _render(
    scenes: list[PointGrid], settings: HologramSettings, *, keep_complex: bool, response_rad: ArrayLike | None
) -> list[Rendered]:
    clock = Clock.start()
    plan = zone_plan(settings)
    clock.lap("table")
    if not plan.zones or not any(scene.amplitude.any() for scene in scenes):
        return [_dark_frame(plan, settings, clock, keep_complex) for _ in scenes]
    grid = synthesis_grid(plan, settings.panel)
    holograms, skipped = synthesise(plan, grid, scenes, device=settings.device)
    clock.lap("synthesis")
    return [
        _frame(one, plan, grid, settings, skipped, clock.fork(len(scenes)), keep_complex, response_rad)
        for one in holograms
    ]


def _frame(
    hologram: torch.Tensor,
    plan: ZonePlan,
    grid: Grid,
    settings: HologramSettings,
    skipped: list[str],
    clock: Clock,
    keep_complex: bool,
    response_rad: ArrayLike | None,
) -> Rendered:
    """Encode one hologram that is divided by the reference and sampled on `grid`."""
    panel = settings.panel
    transform = _transform(settings)
    window = torch.from_numpy(_window_mask(settings)).to(settings.device)
    wanted = _spectrum(hologram, transform, grid, panel)
    start = transform.adjoint(wanted)
    clock.lap("to panel")
    complex_field = _undivided(hologram, plan, grid, settings) if keep_complex else None
    clock.lap("complex field")
    encoded: Encoded = ifta(start, wanted, window, transform, iterations=settings.iterations)
    clock.lap("ifta")
    phase = panel_phase(encoded.field, plan.reference_turns, panel)
    levels = phase_to_levels(phase, response_rad)
    clock.lap("levels")
    return Rendered(
        levels, phase, complex_field, clock.seconds, list(skipped), encoded.efficiency, encoded.signal_error
    )


@lru_cache(maxsize=2)
def _window_mask(settings: HologramSettings) -> NDArray[np.bool_]:
    """Return which bins of the compact spectrum lie in the pupil's image."""
    window, panel = zone_plan(settings).window, settings.panel
    transform, margin = _transform(settings), _MARGIN_BINS / (min(panel.width, panel.height) * panel.pitch_m)
    return window.contains(*transform.frequencies(panel.pitch_m, panel.pitch_m), margin_per_m=margin)


def _transform(settings: HologramSettings) -> WindowedTransform:
    """Return the transform between the panel's pixels and the bins round the pupil's image."""
    panel = settings.panel
    reach_x, reach_y = zone_plan(settings).window.half_size_per_m
    return WindowedTransform(
        panel.height,
        panel.width,
        int(np.ceil(reach_y * panel.height * panel.pitch_m + _MARGIN_BINS)),
        int(np.ceil(reach_x * panel.width * panel.pitch_m + _MARGIN_BINS)),
        settings.device,
    )


def _spectrum(hologram: torch.Tensor, transform: WindowedTransform, grid: Grid, panel: Panel) -> torch.Tensor:
    """Return the compact spectrum, on the panel's pixels, of a hologram sampled on `grid`."""
    reach = (transform.reach_rows, transform.reach_columns)
    coarse = WindowedTransform(grid.rows, grid.columns, *reach, transform.device)
    return resample_compact(coarse.forward(hologram), reach, grid, panel_grid(panel))


def _undivided(hologram: torch.Tensor, plan: ZonePlan, grid: Grid, settings: HologramSettings) -> NDArray[np.complex64]:
    """Return the full-complex hologram on the panel's pixels, with the reference put back."""
    panel = settings.panel
    if grid != panel_grid(panel):
        reach = ((grid.rows - 1) // 2, (grid.columns - 1) // 2)
        transform = WindowedTransform(panel.height, panel.width, *reach, settings.device)
        hologram = transform.adjoint(_spectrum(hologram, transform, grid, panel))
    else:
        hologram = hologram.clone()
    for top in range(0, panel.height, _BLOCK):
        part = slice(top, top + _BLOCK)
        turns = torch.from_numpy(plan.reference_turns.on_grid(panel.x_m, panel.y_m[part]))
        turns.sub_(torch.round(turns)).mul_(2 * np.pi)
        phase = turns.to(torch.float32)
        hologram[part].mul_(torch.polar(torch.ones_like(phase), phase).to(hologram.device))
    return np.asarray(hologram.cpu().numpy())


def _dark_frame(plan: ZonePlan, settings: HologramSettings, clock: Clock, keep_complex: bool) -> Rendered:
    """Return the frame that shows nothing: the uniform panel sends all light to its zero order, outside the pupil."""
    shape = (settings.panel.height, settings.panel.width)
    return Rendered(
        np.zeros(shape, np.uint8),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.complex64) if keep_complex else None,
        dict(clock.seconds),
        [*plan.left_out(), "nothing in the image is on the panel and bright: the frame is uniform"],
        0.0,
    )


@dataclass
class Clock:
    """Seconds per stage."""

    seconds: dict[str, float]
    last: float

    @classmethod
    def start(cls) -> Clock:
        """Return a clock that has just begun."""
        return cls({}, time.perf_counter())

    def lap(self, stage: str) -> None:
        """Book the time since the last lap."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now

    def fork(self, shares: int) -> Clock:
        """Return a clock for one of several frames that share the time booked so far."""
        return Clock({stage: spent / shares for stage, spent in self.seconds.items()}, time.perf_counter())
