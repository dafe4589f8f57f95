"""Points to the full-complex hologram on the panel, by the method that the settings name.

What does not depend on the scene - phase functions, patches, masks, sorted samples - is made once per setting and
kept; what depends on where the points are, for the last few sets of points.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from holocal.errors import SamplingError
from holocal.hologram.clock import Clock
from holocal.hologram.depths import depth_bins
from holocal.hologram.direct import direct_hologram
from holocal.hologram.scenes.points import Aperture, PointCloud
from holocal.hologram.settings import Direct, HologramSettings, Zones
from holocal.hologram.stored import Store, stored_plan
from holocal.hologram.warp import Depth
from holocal.hologram.warped import accuracy_of
from holocal.hologram.warped_sum import Complex, PatchSums, ToPanel, patch_sums, phasor, to_panel, tolerance_of
from holocal.hologram.zone_sum import zones_on_panel
from holocal.hologram.zones import zone_plan
from holocal.optics.bench import Array

_ENGINES_KEPT = 2  # 0.7 GB each on the 4K panel, points included
_KEPT = 1  # sets of points whose transforms are kept: 0.5 GB for 750 x 750 points on the 4K panel
_DIMMEST, _BRIGHTEST = 1e-12, 1e12  # amplitudes: sums over 1e8 points and their squares stay normal float32 numbers
_DENSE = 0.5  # share of lit points from which a scene's dark points are summed too: the transforms stay those of before
_FEW = 5  # points of one depth are summed one by one: 4 FFT pairs each, where a new depth's plan and transform take 20


@dataclass(frozen=True)
class Hologram:
    """`field` (height, width) complex64, divided by the reference; `skipped` a sentence for each thing left out."""

    field: torch.Tensor
    skipped: list[str]


def synthesise(
    clouds: Sequence[PointCloud],
    settings: HologramSettings,
    *,
    reach: tuple[int, int],
    clock: Clock,
    store: Store | None = None,
) -> Hologram | None:
    """Return the hologram of clouds of points; None where none of them has light.

    `reach` (rows, columns) are the largest frequency indices on the panel that the encoder asks for; `store` keeps
    phase functions between programs.
    """
    lit = [cloud for cloud in clouds if np.any(cloud.amplitude > 0)]
    lit, skipped = _in_range(lit)
    if len(lit) < len(clouds):
        skipped.append(f"{len(clouds) - len(lit)} of {len(clouds)} layers or views: dark")
    if not lit:
        return None
    if isinstance(settings.method, Direct):
        pixels = direct_hologram(settings, lit)
        clock.lap("synthesis")
        return Hologram(torch.from_numpy(pixels).to(settings.device), skipped) if pixels.any() else None
    if isinstance(settings.method, Zones):
        return _by_zones(lit, settings, reach, clock, skipped)
    return _by_patches(lit, settings, clock, skipped, store)


def _in_range(clouds: list[PointCloud]) -> tuple[list[PointCloud], list[str]]:
    """Return clouds whose amplitudes float32 can hold, sum and square, and a sentence where they were scaled for it."""
    peak = max((float(cloud.amplitude.max()) for cloud in clouds), default=1.0)
    if _DIMMEST <= peak <= _BRIGHTEST:
        return clouds, []
    scaled = [replace(cloud, amplitude=np.asarray(cloud.amplitude, np.float64) / peak) for cloud in clouds]
    return scaled, [f"the scene's scale: its brightest amplitude, {peak:.3g}, became 1, for float32 to hold it"]


def _by_zones(
    clouds: list[PointCloud], settings: HologramSettings, reach: tuple[int, int], clock: Clock, skipped: list[str]
) -> Hologram | None:
    total = None
    for cloud in clouds:
        chosen = cloud.lit()
        for depth, index in depth_bins(chosen, settings):
            # a zone's points share one wavefront: they lie on a sphere, and a plane's middle decides which
            distance = 1 / depth.inverse_m if depth.inverse_m else np.inf
            plan = zone_plan(replace(settings, depth_m=distance))
            clock.lap("table")
            if not plan.zones:
                continue
            part = chosen.part(index)
            found, dark = zones_on_panel(plan, settings, part.field_tan, _strengths(part), reach)
            total = found if total is None else total.add_(found)
            skipped += plan.left_out()
            if dark:
                skipped.append(f"{dark} of {len(plan.zones)} zones on the panel: dark in the scene")
            clock.lap("synthesis")
    return None if total is None else Hologram(total, skipped)


def _by_patches(
    clouds: list[PointCloud], settings: HologramSettings, clock: Clock, skipped: list[str], store: Store | None
) -> Hologram | None:
    many, few = _shared_out(clouds, settings)
    clock.lap("synthesis")
    pixels = _many(many, settings, clock, skipped, store) if many else None
    if few:
        pixels = direct_hologram(settings, few, pixels)
        clock.lap("synthesis")
        if not many and not pixels.any():
            return None
    return None if pixels is None else Hologram(torch.from_numpy(pixels).to(settings.device), skipped)


def _shared_out(
    clouds: list[PointCloud], settings: HologramSettings
) -> tuple[list[tuple[Depth, PointCloud]], list[PointCloud]]:
    """Return the clouds depth by depth, and apart from them the points of depths that hold too few for a plan."""
    many, few = [], []
    for cloud in clouds:
        chosen = cloud if np.count_nonzero(cloud.amplitude) >= _DENSE * len(cloud) else cloud.lit()
        for depth, index in depth_bins(chosen, settings):
            part = chosen if len(index) == len(chosen) else chosen.part(index)
            if len(part) <= _FEW:
                few.append(part)
            else:
                many.append((depth, part))
    return many, few


def _many(
    parts: list[tuple[Depth, PointCloud]],
    settings: HologramSettings,
    clock: Clock,
    skipped: list[str],
    store: Store | None,
) -> Complex | None:
    """Return the field on the panel of points that share depths, by patches."""
    engine = _engine(settings, store)
    clock.lap("plans")
    spectrum: Complex | None = None
    dark = count = 0
    for aperture, group in _by_aperture(parts).items():
        on_grid: Complex | None = None
        for depth, cloud in group:
            strengths = _strengths(cloud)
            clock.lap("synthesis")
            sums = engine.sums(depth, cloud.field_tan)
            clock.lap("plans")
            dark, count = dark + sums.dark, count + sums.dark + len(sums.sums)
            if sums.sums:
                found = sums.on_grid(strengths)
                on_grid = found if on_grid is None else np.add(on_grid, found, out=on_grid)
            clock.lap("synthesis")
        if on_grid is not None:
            masked = engine.panel.spectrum(on_grid, engine.mask(aperture, clock))
            spectrum = masked if spectrum is None else np.add(spectrum, masked, out=spectrum)
            clock.lap("synthesis")
    if dark:
        skipped.append(f"{dark} of {count} patches of the panel: show no lit point")
    pixels = None if spectrum is None else engine.panel.pixels(spectrum)
    clock.lap("synthesis")
    return pixels


def _by_aperture(parts: list[tuple[Depth, PointCloud]]) -> dict[Aperture | None, list[tuple[Depth, PointCloud]]]:
    groups: dict[Aperture | None, list[tuple[Depth, PointCloud]]] = {}
    for depth, cloud in parts:
        groups.setdefault(cloud.aperture, []).append((depth, cloud))
    return groups


def _strengths(cloud: PointCloud) -> Complex:
    """Return complex amplitudes (n,)."""
    out = phasor(np.asarray(cloud.phase_rad, np.float64))
    out *= cloud.amplitude.astype(np.float32)
    return out


@dataclass
class WarpedEngine:
    """What a setting's holograms share, made when first needed: the transform to the panel, masks, patches' sums."""

    settings: HologramSettings
    cut: tuple[int, int]
    panel: ToPanel
    store: Store | None
    error_rad: float  # of points at infinity
    masks: dict[Aperture | None, Complex] = field(default_factory=dict)
    kept: OrderedDict[tuple[Depth, bytes], PatchSums] = field(default_factory=OrderedDict)

    def mask(self, aperture: Aperture | None, clock: Clock) -> Complex:
        """Return the mask of the pupil, or of a part of it."""
        if aperture not in self.masks:
            if len(self.masks) >= 32:
                self.masks.clear()
            self.masks[aperture] = self.panel.mask(self.settings.bench.pupil_diameter_m, aperture)
            clock.lap("plans")
        return self.masks[aperture]

    def sums(self, depth: Depth, field_tan: Array) -> PatchSums:
        """Return the transforms of points at one depth and tangents (n, 2), made if they are not kept."""
        key = (depth, _digest(field_tan))
        sums = self.kept.pop(key, None)
        if sums is None:
            plan = stored_plan(self.settings, depth, self.cut, self.store)
            accuracy = accuracy_of(self.settings)
            if plan.error_rad > max(accuracy, self.error_rad):
                raise SamplingError(
                    f"Points {1 / depth.inverse_m:.3g} m from the pupil are shown with a wavefront error of "
                    f"{plan.error_rad:.2g} rad (rms), not {accuracy:.2g}.",
                    why="The patches of the panel are chosen for points far away.",
                    fix="Move them farther away, ask for a larger --accuracy, or use --method direct.",
                    measured=plan.error_rad,
                    limit=accuracy,
                )
            while len(self.kept) >= _KEPT:  # first, so that one too many is never there
                self.kept.popitem(last=False)
            sums = patch_sums(plan, field_tan, tolerance=tolerance_of(self.settings))
        self.kept[key] = sums
        return sums


def _digest(values: NDArray[np.float64]) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(values).data, digest_size=16).digest()


def _engine(settings: HologramSettings, store: Store | None) -> WarpedEngine:
    """Return the engine of a setting, whatever its depth and number of iterations."""
    return _ENGINES.of(settings.of_plans(), store)


@dataclass
class Engines:
    """The engines of the last settings; a second one for a program that goes to and fro between two colours."""

    kept: OrderedDict[tuple[HologramSettings, Store | None], WarpedEngine] = field(default_factory=OrderedDict)

    def of(self, settings: HologramSettings, store: Store | None) -> WarpedEngine:
        """Return the engine of a setting, made if it is not kept."""
        key = (settings, store)
        found = self.kept.pop(key, None)
        if found is None:
            while len(self.kept) >= _ENGINES_KEPT:  # first, so that three are never there at once
                self.kept.popitem(last=False)
            far = stored_plan(settings, Depth(0.0), None, store)
            panel = to_panel(far.layout, settings.panel, tolerance=tolerance_of(settings))
            found = WarpedEngine(settings, far.layout.cut, panel, store, far.error_rad)
        self.kept[key] = found
        return found


_ENGINES = Engines()


def forget_engines() -> None:
    """Throw away what settings share: the next hologram is made from nothing, but for plans that `warped` keeps."""
    _ENGINES.kept.clear()


def forget_points() -> None:
    """Throw away the transforms of points seen before; what belongs to the panel stays."""
    for engine in _ENGINES.kept.values():
        engine.kept.clear()
