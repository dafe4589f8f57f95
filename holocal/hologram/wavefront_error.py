"""How wrong the wavefront of a point is, in the thesis's zones and in warped patches (docs/physics.md 4).

``python -m holocal.hologram.wavefront_error`` prints the table.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from holocal.hologram.settings import HologramSettings, Warped, Zones
from holocal.hologram.warp import Depth
from holocal.hologram.warped import accurate_plan, inside_outline, warped_plan
from holocal.hologram.zones import zone_borders, zone_count
from holocal.optics.bench import Array, Bench, Panel, image_tangents
from holocal.optics.phase_function import VirtualPoints, exact_phase

_PANEL_SAMPLES = (48, 27)


def zone_wavefront_error(settings: HologramSettings, *, samples: int = 35) -> float:
    """Return the rms over image points of the rms, radians, of a zone's wavefront against the exact one.

    For each of samples x samples points over the field: its exact phase minus that of its zone's centre, over the part
    of its footprint that lies on the panel, after the best tilt and piston. Points whose footprint misses the panel do
    not count.

    Parameters
    ----------
    settings
        Bench, panel, wavelength, field and zones; the rest does not matter.
    """
    return zone_wavefront_errors(settings, [zone_count(settings)], samples=samples)[0]


def zone_wavefront_errors(settings: HologramSettings, zones: Sequence[int], *, samples: int = 35) -> list[float]:
    """Return `zone_wavefront_error` for several numbers of zones; the points are traced once."""
    half_x, half_y = settings.panel.half_size_m
    x, y = np.linspace(-half_x, half_x, _PANEL_SAMPLES[0]), np.linspace(half_y, -half_y, _PANEL_SAMPLES[1])
    slm = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = np.stack(np.meshgrid(*image_tangents(samples, samples, settings.fov_rad)), axis=-1).reshape(-1, 2)
    shared = [_shared_phase(replace(settings, method=Zones(count)), points, slm) for count in zones]
    squares: list[list[Array]] = [[] for _ in zones]
    for part in np.array_split(np.arange(len(points)), max(1, len(points) // 100)):
        own, inside = _phase(settings, points[part], slm)
        for square, (phase, zone) in zip(squares, shared, strict=True):
            square.append(best_tilt_residual(own - phase[zone[part]], slm, inside) ** 2)
    return [float(np.sqrt(np.nanmean(np.concatenate(square)))) for square in squares]


def _shared_phase(settings: HologramSettings, points: Array, slm_m: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the phases of the zones' centres at panel points, (zones^2, k), and each point's zone, (n,)."""
    borders = zone_borders(settings)
    column, row = (
        np.clip(np.searchsorted(border, points[:, axis], side="right") - 1, 0, zone_count(settings) - 1)
        for axis, border in enumerate(borders)
    )
    middle_x, middle_y = ((border[1:] + border[:-1]) / 2 for border in borders)
    centres = np.stack(np.meshgrid(middle_x, middle_y), axis=-1).reshape(-1, 2)
    return _phase(settings, centres, slm_m)[0], row * zone_count(settings) + column


def patch_wavefront_errors(settings: HologramSettings, *, samples: int = 15) -> Array:
    """Return, for samples x samples points over the field, the rms error of the warped engine's phase, (n,) radians.

    The points lie at the settings' depth, on a sphere about the pupil's centre.
    Over the part of the footprint that lies on the panel, after the best piston; no tilt is taken out. NaN for points
    whose footprint misses the panel.
    """
    plan = accurate_plan(settings)
    if np.isfinite(settings.depth_m):
        plan = warped_plan(settings, Depth(1 / settings.depth_m), plan.layout.cut)
    half_x, half_y = settings.panel.half_size_m
    x, y = np.linspace(-half_x, half_x, _PANEL_SAMPLES[0]), np.linspace(half_y, -half_y, _PANEL_SAMPLES[1])
    slm = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) * 0.999
    points = np.stack(np.meshgrid(*image_tangents(samples, samples, settings.fov_rad)), axis=-1).reshape(-1, 2)
    s = plan.layout.sight.to_sight.at(slm)
    found = np.full((len(points), len(s)), np.nan)
    for form in plan.forms:
        box = form.patch.box
        here = np.flatnonzero(np.all(np.abs(s - box.centre) <= box.half * (1 + 1e-9), axis=-1))
        shown = np.flatnonzero(inside_outline(points, form.seen))
        ub = form.warp.field.at(points[shown])
        phase = form.warp.phase_rad.at(s[here]) + ub[:, 2:] + ub[:, :2] @ form.warp.coordinate.at(s[here]).T
        found[np.ix_(shown, here)] = phase + plan.layout.sight.reference_rad(s[here])
    exact, inside = _phase(settings, points, slm)
    errors = np.full(len(points), np.nan)
    for i, (phase, wanted, weight) in enumerate(zip(found, exact, inside, strict=True)):
        lit = weight > 0
        if lit.sum() >= 12:  # of 1300 samples
            errors[i] = np.std(phase[lit] - wanted[lit])
    return errors


def best_tilt_residual(phase_rad: Array, slm_m: Array, inside: Array) -> Array:
    """Return the rms of phases (n, k) over their footprints after the best tilt and piston, (n,); NaN without any.

    `slm_m` (k, 2) panel points, `inside` (n, k) 1 in the footprint and 0 outside.
    """
    plane = np.concatenate([slm_m / np.abs(slm_m).max(), np.ones((len(slm_m), 1))], axis=1)
    inside_count = inside.sum(axis=-1)
    enough = inside_count >= 12  # of 1300 samples; a plane takes three
    normal = np.einsum("nk,ki,kj->nij", inside[enough], plane, plane)
    right = np.einsum("nk,ki,nk->ni", inside[enough], plane, phase_rad[enough])
    # footprints that touch the panel in a line of samples have no tilt across it: the least one is taken
    fitted = (np.linalg.pinv(normal, hermitian=True) @ right[..., None])[..., 0] @ plane.T
    rms = np.full(len(phase_rad), np.nan)
    rms[enough] = np.sqrt(np.sum(inside[enough] * (phase_rad[enough] - fitted) ** 2, axis=-1) / inside_count[enough])
    return rms


def _phase(settings: HologramSettings, field_tan: Array, slm_m: Array) -> tuple[Array, Array]:
    """Return exact phases (n, k) at panel points, and where they lie in the footprints (1 or 0)."""
    points = VirtualPoints.at(field_tan[:, None], settings.depth_m)
    found = exact_phase(
        settings.bench, points, slm_m, wavelength_m=settings.wavelength_m, gaze_rad=settings.gaze_rad, steps=4
    )
    radius = np.linalg.norm(found.pupil_m, axis=-1)
    return found.phase_rad, (radius <= settings.bench.pupil_diameter_m / 2).astype(np.float64)


def main() -> None:
    """Print the table of docs/physics.md 4."""
    field = float(np.deg2rad(25.0))
    start = HologramSettings(Panel(3840, 2160, 3.74e-6), Bench(), 515e-9, (field, field))
    counts = (1, 2, 3, 5, 7)
    for zones, error in zip(counts, zone_wavefront_errors(start, counts), strict=True):
        sys.stdout.write(f"{zones} x {zones} zones: {error:.2f} rad rms\n")
    for accuracy in (0.3, 0.1, 0.03):
        errors = patch_wavefront_errors(replace(start, method=Warped(accuracy)))
        rms, high = np.sqrt(np.nanmean(errors**2)), np.nanpercentile(errors, 95)
        sys.stdout.write(f"warped, {accuracy:g} rad asked: {rms:.3f} rad rms, 95 % of the points below {high:.3f}\n")


if __name__ == "__main__":
    main()
