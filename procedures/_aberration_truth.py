"""How far an estimate of the aberrations is from a simulated bench's own, by exact path lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Bench, Panel, Pose
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.zernike import noll_to_nm, zernike
from procedures._aberration_spots import EDGE_M, soft_disc

Array = NDArray[np.float64]

GRID = (41, 25)  # points of the panel
ROUNDS = 8  # of the search for the direction that the spot is seen along


def true_bench(nominal: Bench, truth: Mapping[str, Any]) -> Bench:
    """Return the bench that a simulated rig's truth describes."""
    found = truth["misalignment"]

    def pose(name: str) -> Pose:
        turn = np.radians(found[f"{name}_rotation_deg"])
        shift = 1e-3 * np.asarray(found[f"{name}_shift_mm"])
        return Pose((turn[0], turn[1], turn[2]), (shift[0], shift[1], shift[2]))

    return replace(nominal, mirror=pose("mirror"), slm=pose("slm"))


def residuals_rad(
    nominal: Bench,
    panel: Panel,
    truth: Mapping[str, Any],
    field_tan: Array,
    *,
    wavelength_m: float,
    noll: Sequence[int],
    coefficients_rad: Array,
) -> Array:
    """Return what an estimate of the bench's wavefronts leaves in every direction, (zones,) radians rms; NaN if dark.

    W(x) = phi_nominal_p(x) - phi_true_p'(x) + the panel's own path, p' such that no tilt is left; the estimate
    (zones, modes) is taken off at the nominal bench's pupil points; piston and tilt are removed. Weighted by the light:
    what passes the true pupil of what a hologram of the nominal bench sends.
    """
    bench = true_bench(nominal, truth)
    flatness = truth.get("slm", {}).get("flatness_nm") or []
    half = np.asarray(panel.half_size_m)
    line = [(np.arange(n) + 0.5) / n * 2 - 1 for n in GRID]
    x = np.stack(np.meshgrid(line[0] * half[0], line[1] * half[1]), axis=-1).reshape(-1, 2)
    own = np.zeros(len(x))
    for index, rms_nm in flatness:
        local = x / np.hypot(*half)
        own += 2 * np.pi / wavelength_m * rms_nm * 1e-9 * zernike([index], local[:, 0], local[:, 1])[0]
    left = [
        _zone(nominal, bench, x, own, tangent, wavelength_m, noll, found)
        for tangent, found in zip(field_tan, coefficients_rad, strict=True)
    ]
    return np.array(left)


def _zone(
    nominal: Bench, bench: Bench, x: Array, own: Array, tangent: Array, wavelength_m: float, noll: Sequence[int],
    coefficients_rad: Array,
) -> float:  # fmt: skip
    k, radius = 2 * np.pi / wavelength_m, nominal.pupil_diameter_m / 2
    there = exact_phase(nominal, VirtualPoints.at(tangent), x, wavelength_m=wavelength_m)
    local = there.pupil_m / radius
    estimated = coefficients_rad @ zernike(noll, local[:, 0], local[:, 1]) if len(noll) else np.zeros(len(x))
    sent = soft_disc(there.pupil_m, radius, EDGE_M)
    seen = np.array(tangent, np.float64)
    for _ in range(ROUNDS):
        real = exact_phase(bench, VirtualPoints.at(seen), x, wavelength_m=wavelength_m)
        lit = (real.error_m < 1e-9) & (there.error_m < 1e-9)
        amount = np.where(lit, (soft_disc(np.nan_to_num(real.pupil_m), radius, EDGE_M) * sent) ** 2, 0.0)
        amount = amount * np.where(lit, _area(np.nan_to_num(real.pupil_m)), 0.0)
        search = amount if amount.sum() > 0 else np.where(lit, sent**2, 0.0)
        if np.count_nonzero(search) < 6:
            return float("nan")
        error = np.nan_to_num(there.phase_rad - real.phase_rad) + own
        slope, _ = _without_plane(error, np.nan_to_num(real.pupil_m), search)
        sines = seen / np.sqrt(1 + seen @ seen) - slope / k
        seen = sines / np.sqrt(1 - sines @ sines)
    if np.count_nonzero(amount) < 6:
        return float("nan")
    _, rest = _without_plane(error - estimated, np.nan_to_num(there.pupil_m), amount)
    return float(np.sqrt(np.sum(amount * rest**2) / amount.sum()))


def _without_plane(values: Array, pupil_m: Array, weight: Array) -> tuple[Array, Array]:
    """Return the slope (2,) per metre of the best plane, and the values less it."""
    root = np.sqrt(weight / weight.sum())
    plane = np.concatenate([np.ones((len(values), 1)), 1e3 * pupil_m], axis=1)
    centred = values - np.sum(root**2 * values)
    found = np.linalg.lstsq(plane * root[:, None], centred * root, rcond=None)[0]
    return 1e3 * found[1:], centred - plane @ found


def _area(pupil_m: Array) -> Array:
    """Return how much of the pupil's plane each point of the panel's grid stands for, (n,)."""
    grid = pupil_m.reshape(GRID[1], GRID[0], 2)
    steps = np.stack([np.gradient(grid, axis=0), np.gradient(grid, axis=1)], axis=-1)
    return np.asarray(np.abs(np.linalg.det(steps)).ravel())


def highest_order(noll: Sequence[int]) -> int:
    """Return the highest radial order of Noll indices."""
    return max(noll_to_nm(j)[0] for j in noll)
