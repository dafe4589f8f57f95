"""Where a simulated bench's rays are seen, against where the verification's spots were to be seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.loop.procedure import Conclusion
from holocal.optics.bench import Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.threads import each
from procedures._aberration_truth import GRID, Light, light_of_spot, panel_points, true_bench

Array = NDArray[np.float64]

LEAST_LIT = 0.004  # of the pupil: a spot with less is dark


def against_truth(done: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Return `residual_px` and `before_px` (rms, max) of the verification's directions by exact rays, free of noise."""
    facts, checked = done.extra["rig_facts"], done.extra["checked"]
    sent, wanted = np.array(checked["sent_tan"]).reshape(-1, 2), np.array(checked["wanted_tan"]).reshape(-1, 2)
    diameter = (truth.get("camera") or {}).get("pupil_mm")
    nominal = Bench.nominal(
        pupil_diameter_m=facts["pupil_diameter_m"] if diameter is None else 1e-3 * diameter,
        eye_relief_m=facts["eye_relief_m"],
    )
    panel = Panel(int(facts["panel_width"]), int(facts["panel_height"]), facts["pitch_m"])
    wavelength_m = 1e-9 * float(facts["wavelength_nm"])
    bench = true_bench(nominal, truth)
    after = seen_tangents_of(nominal, bench, panel, truth, sent, wavelength_m) - wanted
    before = seen_tangents_of(nominal, bench, panel, truth, wanted, wavelength_m) - wanted
    return {
        "residual_px": _summary(after / facts["pixel_tan"]),
        "before_px": _summary(before / facts["pixel_tan"]),
    }


def seen_tangents_of(
    drawn: Bench, bench: Bench, panel: Panel, truth: Mapping[str, Any], sent: Array, wavelength_m: float
) -> Array:
    """Return where points sent along tangents (n, 2) by holograms for a drawn bench are seen on a true one, (n, 2)."""
    x, own = panel_points(panel, truth, wavelength_m)
    beam = illumination(x, truth)
    pupil_area = np.pi * (drawn.pupil_diameter_m / 2) ** 2

    def seen(tangent: Array) -> Array:
        light = light_of_spot(drawn, bench, x, own, tangent, wavelength_m)
        if light is None or light.amount.sum() < LEAST_LIT * pupil_area:
            return np.full(2, np.nan)
        pixels = pixel_light(drawn, panel, x, tangent, wavelength_m)
        return middle(replace(light, amount=light.amount * beam * pixels), wavelength_m)

    return np.stack(each(lambda k: seen(sent[k]), len(sent))) if len(sent) else np.zeros((0, 2))


def illumination(x: Array, truth: Mapping[str, Any]) -> Array:
    """Return the beam's intensity at points of the panel (n, 2), (n,), 1 in the middle."""
    beam = truth.get("illumination") or {}
    if beam.get("profile") != "gaussian":
        return np.ones(len(x))
    return np.asarray(np.exp(-2 * np.sum(x**2, axis=1) / (1e-3 * float(beam["waist_mm"])) ** 2))


def pixel_light(nominal: Bench, panel: Panel, x: Array, tangent: Array, wavelength_m: float) -> Array:
    """Return what the pixels' areas send of a spot's light at an even grid of points (n, 2), (n,): sinc squared."""
    turns = exact_phase(nominal, VirtualPoints.at(tangent), x, wavelength_m=wavelength_m).phase_rad / (2 * np.pi)
    grid, at = turns.reshape(GRID[1], GRID[0]), x.reshape(GRID[1], GRID[0], 2)
    slopes = np.gradient(grid, at[0, :, 0], axis=1), np.gradient(grid, at[:, 0, 1], axis=0)
    made = np.ones_like(grid)
    for slope, own in zip((np.asarray(one) for one in slopes), panel.illumination_frequency_per_m, strict=True):
        made *= np.sinc((slope - own) * panel.pitch_m) ** 2
    return np.asarray(made.ravel())


def middle(light: Light, wavelength_m: float) -> Array:
    """Return the tangents (2,) of the middle of a spot's light: of its rays' directions, each as bright as it is."""
    weight = light.amount / light.amount.sum()
    error, pupil = light.error_rad.reshape(GRID[1], GRID[0]), light.pupil_m.reshape(GRID[1], GRID[0], 2)
    by_panel = np.stack([np.asarray(np.gradient(error, axis=axis)).ravel() for axis in (0, 1)], axis=-1)
    moved = np.stack([np.asarray(np.gradient(pupil, axis=axis)).reshape(-1, 2) for axis in (0, 1)], axis=1)
    inside = (weight > 0) & (np.abs(np.linalg.det(moved)) > 0)
    slope = np.linalg.solve(moved[inside], by_panel[inside][..., None])[..., 0]
    mean = np.asarray(weight[inside] @ slope / weight[inside].sum())
    sines = light.seen / np.sqrt(1 + light.seen @ light.seen) - mean * wavelength_m / (2 * np.pi)
    return np.asarray(sines / np.sqrt(1 - sines @ sines))


def _summary(off_px: Array) -> dict[str, Any]:
    distance = np.linalg.norm(off_px, axis=1)
    distance = distance[np.isfinite(distance)]
    if not len(distance):
        return {"rms": None, "max": None, "points": 0}
    return {"rms": float(np.sqrt(np.mean(distance**2))), "max": float(distance.max()), "points": len(distance)}
