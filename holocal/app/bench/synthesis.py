"""Synthesis: run time against error for every method, and how the cost falls with what a scene contains."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from holocal.app.bench.measure import Unit
from holocal.hologram import synthesis as engine
from holocal.hologram import warped
from holocal.hologram.clock import Clock
from holocal.hologram.direct import direct_sum
from holocal.hologram.scenes.image import RandomPhase, image_cloud
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import Direct, HologramSettings, Method, Warped, Zones
from holocal.hologram.wavefront_error import patch_wavefront_errors, zone_wavefront_error
from holocal.optics.bench import Bench, Panel

Row = dict[str, Any]
PIXELS = 750  # the image: 750 x 750 points over 25 x 25 degrees
JUDGED_POINTS, JUDGED_PIXELS = 200, 2000
METHODS: tuple[Method, ...] = (Warped(0.3), Warped(0.1), Warped(0.03), Zones(5), Direct())
_WHOLE = (10**6, 10**6)


def settings_of(width: int, height: int, method: Method) -> HologramSettings:
    """Return the thesis's bench and field with a panel of a size, 3.74 um pitch."""
    field = float(np.deg2rad(25.0))
    return HologramSettings(Panel(width, height, 3.74e-6), Bench.nominal(), 515e-9, (field, field), method=method)


def picture(settings: HologramSettings, *, seed: int = 0) -> PointCloud:
    """Return a scene in which every one of 750 x 750 points is lit."""
    intensity = np.random.default_rng(7).uniform(0.05, 1.0, (PIXELS, PIXELS))
    return image_cloud(intensity, fov_rad=settings.fov_rad, initial_phase=RandomPhase(seed))


def methods(width: int, height: int, *, runs: int) -> Iterator[Row]:
    """Yield a row per method: seconds warm and cold, and its error against the direct float64 sum."""
    unit = Unit(height, width)
    for method in METHODS:
        settings = settings_of(width, height, method)
        name = {"table": "synthesis", "size": f"{width}x{height}", "method": name_of(method)}
        scene = picture(settings)
        if isinstance(method, Direct):
            yield name | _direct(unit, settings, scene)
            continue
        forget()
        began = time.perf_counter()
        synthesise(scene, settings)
        cold = time.perf_counter() - began
        timing = unit.ratio(partial(synthesise, scene, settings), runs=runs)
        yield name | timing.row() | {"cold_seconds": cold} | _errors(settings)


def densities(width: int, height: int, *, runs: int) -> Iterator[Row]:
    """Yield a row per scene density for the default method: warm, and with points never seen before."""
    unit, settings = Unit(height, width), settings_of(width, height, Warped())
    scene = picture(settings)
    rng = np.random.default_rng(3)
    sparse = {share: rng.random(len(scene)) < share for share in (0.5, 0.1, 0.01)}
    block = np.zeros((PIXELS, PIXELS), np.bool_)
    block[300:375, 400:475] = True
    chosen = {
        "all points": np.ones(len(scene), np.bool_),
        **{f"{share:.0%} of the points": mask for share, mask in sparse.items()},
        "1% of the points, one block": block.ravel(),
        "black": np.zeros(len(scene), np.bool_),
    }
    for name, lit in chosen.items():
        part = replace(scene, amplitude=np.where(lit, scene.amplitude, 0.0))
        synthesise(scene, settings)  # the panel's side is made
        clock = Clock.start()
        engine.forget_points()
        engine.synthesise([part], settings, reach=_WHOLE, clock=clock)
        first = sum(clock.seconds.values())
        timing = unit.ratio(partial(synthesise, part, settings), runs=runs)
        yield (
            {"table": "density", "size": f"{width}x{height}", "scene": name}
            | timing.row()
            | {
                "new_points_seconds": first,
                "new_points_ratio_p": first / timing.unit_seconds,
            }
        )


def name_of(method: Method) -> str:
    """Return a method's name in the tables."""
    if isinstance(method, Warped):
        return f"warped, {method.accuracy_rad:g} rad asked"
    return f"zones {method.count} x {method.count} (thesis)" if isinstance(method, Zones) else "direct sum"


def synthesise(scene: PointCloud, settings: HologramSettings) -> engine.Hologram | None:
    """Return the hologram of one cloud."""
    return engine.synthesise([scene], settings, reach=_WHOLE, clock=Clock.start())


def forget() -> None:
    """Throw away everything that is kept between scenes."""
    engine.forget_engines()
    warped.forget_plans()


def judged(settings: HologramSettings) -> tuple[PointCloud, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return a scene of few random points, and random panel pixels (rows, columns): what a method is judged on."""
    rng = np.random.default_rng(11)
    tangents = rng.uniform(-1, 1, (JUDGED_POINTS, 2)) * np.tan(np.asarray(settings.fov_rad) / 2)
    phases = 2 * np.pi * rng.random(JUDGED_POINTS)
    scene = PointCloud(tangents, np.full(JUDGED_POINTS, np.inf), np.ones(JUDGED_POINTS), phases)
    panel = settings.panel
    return scene, rng.integers(0, panel.height, JUDGED_PIXELS), rng.integers(0, panel.width, JUDGED_PIXELS)


def relative_error(
    settings: HologramSettings, scene: PointCloud, rows: np.ndarray[Any, Any], columns: np.ndarray[Any, Any]
) -> float:
    """Return the relative L2 distance of a scene's hologram from the direct sum, on some pixels; NaN for a dark one."""
    found = synthesise(scene, settings)
    if found is None:
        return float("nan")
    panel = settings.panel
    exact = direct_sum(settings, [scene], np.stack([panel.x_m[columns], panel.y_m[rows]], axis=-1))
    return float(np.linalg.norm(found.field.numpy()[rows, columns] - exact) / np.linalg.norm(exact))


def _errors(settings: HologramSettings) -> Row:
    row: Row = {"relative_l2": relative_error(settings, *judged(settings))}
    if isinstance(settings.method, Warped):
        errors = patch_wavefront_errors(settings)
        row["wavefront_rms_rad"] = float(np.sqrt(np.nanmean(errors**2)))
        row["wavefront_p95_rad"] = float(np.nanpercentile(errors, 95))
    else:
        row["wavefront_rms_rad"] = zone_wavefront_error(settings, samples=21)
    return row


def _direct(unit: Unit, settings: HologramSettings, scene: PointCloud) -> Row:
    """Return the direct method's row: its time is that of one point, times the points."""
    one = scene.part(np.array([len(scene) // 2]))
    timing = unit.ratio(lambda: synthesise(one, settings), runs=1, warm=False)
    judge, rows, columns = judged(settings)
    # the two points nearest to the gaze: their footprints are on any panel
    few = judge.part(np.argsort(np.sum(judge.field_tan**2, axis=-1))[:2])
    count = len(scene)
    return {
        "seconds": timing.seconds * count,
        "ratio_p": timing.ratio * count,
        "unit_seconds": timing.unit_seconds,
        "note": f"one point measured, times {count}",
        "relative_l2": relative_error(settings, few, rows, columns),
    }
