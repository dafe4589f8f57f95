"""How far an estimate of the aberrations is from a simulated bench's own, by exact path lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.field_model import field_terms
from holocal.loop.procedure import Conclusion
from holocal.optics.bench import Bench, Panel, Pose
from holocal.optics.phase_function import VirtualPoints, exact_phase
from holocal.optics.zernike import noll_to_nm, zernike
from holocal.threads import each
from procedures._aberration_spots import EDGE_M, soft_disc

Array = NDArray[np.float64]

GRID = (41, 25)  # points of the panel
SETTLED = 1e-8  # of a direction, radians; a camera pixel is 6e-4
ROUNDS = 8  # of the search for the direction that the spot is seen along


def true_bench(nominal: Bench, truth: Mapping[str, Any]) -> Bench:
    """Return the bench that a simulated rig's truth describes."""
    found = truth["misalignment"]

    def pose(name: str) -> Pose:
        turn = np.radians(found[f"{name}_rotation_deg"])
        shift = 1e-3 * np.asarray(found[f"{name}_shift_mm"])
        return Pose((turn[0], turn[1], turn[2]), (shift[0], shift[1], shift[2]))

    return replace(nominal, mirror=pose("mirror"), slm=pose("slm"))


def residual_of(done: Conclusion, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the correction leaves of a simulated bench's exact phase, in every zone that is lit."""
    model = done.extra["field"]
    tangents = tangents_of(done)
    values = field_terms(tangents, (model["half_tan"][0], model["half_tan"][1])) @ np.array(model["coefficients_rad"]).T
    after, before = left_of(done, truth, np.stack([values, np.zeros_like(values)]))
    return {"residual_rms_rad": after, "before_rms_rad": before}


def tangents_of(done: Conclusion) -> Array:
    """Return the zones' directions, (zones, 2)."""
    return np.asarray(np.tan(np.radians([zone["field_deg"] for zone in done.before["zones"]])))


def left_of(done: Conclusion, truth: Mapping[str, Any], values: Array) -> list[dict[str, Any]]:
    """Return what aberrations of (sets, zones, modes) radians, taken off, leave of a simulated bench's exact phase.

    Rms over every zone's light, and the median and the worst of the zones that are valid.
    """
    extra = done.extra
    facts, noll = extra["rig_facts"], extra["noll"]
    panel = Panel(int(facts["panel_width"]), int(facts["panel_height"]), facts["pitch_m"])
    diameter = (truth.get("camera") or {}).get("pupil_mm")
    nominal = Bench.nominal(
        pupil_diameter_m=facts["pupil_diameter_m"] if diameter is None else 1e-3 * diameter,
        eye_relief_m=facts["eye_relief_m"],
    )
    # Noll terms are those of the nominal pupil, whatever the camera's own stop.
    scaled = values if diameter is None else _rescaled(values, noll, facts["pupil_diameter_m"] / (1e-3 * diameter))
    left = residuals_rad(
        nominal, panel, truth, tangents_of(done), wavelength_m=float(extra["wavelength_nm"]) * 1e-9, noll=noll,
        coefficients_rad=scaled,
    )  # fmt: skip
    valid = np.array([zone["valid"] for zone in done.before["zones"]])
    return [_summary(one, one[valid & np.isfinite(one)]) for one in left]


def _summary(left: Array, counted: Array) -> dict[str, Any]:
    return {
        "median": float(np.median(counted)) if len(counted) else None,
        "worst": float(np.max(counted)) if len(counted) else None,
        "zones": [float(value) if np.isfinite(value) else None for value in left],
    }


def _rescaled(values: Array, noll: list[int], ratio: float) -> Array:
    """Return coefficients over a disc `1 / ratio` times as wide that are the same wavefront."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 400), np.sqrt(rng.uniform(0, 1, 400))
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    highest = list(range(1, max(noll) + 1))
    wanted = zernike(noll, x / ratio, y / ratio).T @ values.reshape(-1, len(noll)).T
    found = np.linalg.lstsq(zernike(highest, x, y).T, wanted, rcond=None)[0]
    return np.asarray(found[[highest.index(j) for j in noll]].T).reshape(values.shape)


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
    """Return what estimates of the bench's wavefronts leave in every direction, (..., zones) radians rms; NaN if dark.

    W(x) = phi_nominal_p(x) - phi_true_p'(x) + the panel's own path, p' such that no tilt is left; an estimate
    (..., zones, modes) is taken off at the nominal bench's pupil points; piston and tilt are removed. Weighted by the
    light: what passes the true pupil of what a hologram of the nominal bench sends.
    """
    bench = true_bench(nominal, truth)
    x, own = panel_points(panel, truth, wavelength_m)
    sets = int(np.prod(coefficients_rad.shape[:-2]))
    estimates = coefficients_rad.reshape(sets, *coefficients_rad.shape[-2:])
    left = each(
        lambda zone: _zone(nominal, bench, x, own, field_tan[zone], wavelength_m, noll, estimates[:, zone]),
        len(field_tan),
    )
    return np.stack(left, axis=-1).reshape(coefficients_rad.shape[:-1])


@dataclass(frozen=True)
class Light:
    """A spot's light on a true bench, at n points of the panel.

    `seen` (2,) tangents that it is seen along: no tilt is left; `error_rad` (n,) phase there; `nominal_m`, `pupil_m`
    (n, 2) where it crosses the nominal and the true pupil's plane; `amount` (n,) of light that passes.
    """

    seen: Array
    error_rad: Array
    nominal_m: Array
    pupil_m: Array
    amount: Array


def light_of_spot(
    nominal: Bench, bench: Bench, x: Array, own: Array, tangent: Array, wavelength_m: float
) -> Light | None:
    """Return where a spot sent along a tangent (2,) is seen; `own` (n,) is the panel's path. None for a dark one."""
    k, radius = 2 * np.pi / wavelength_m, nominal.pupil_diameter_m / 2
    there = exact_phase(nominal, VirtualPoints.at(tangent), x, wavelength_m=wavelength_m)
    sent = soft_disc(there.pupil_m, radius, EDGE_M)
    seen = np.array(tangent, np.float64)
    for _ in range(ROUNDS):
        real = exact_phase(bench, VirtualPoints.at(seen), x, wavelength_m=wavelength_m)
        lit = (real.error_m < 1e-9) & (there.error_m < 1e-9)
        pupil_m = np.nan_to_num(real.pupil_m)
        amount = np.where(lit, (soft_disc(pupil_m, radius, EDGE_M) * sent) ** 2, 0.0) * np.where(lit, _area(pupil_m), 0)
        search = amount if amount.sum() > 0 else np.where(lit, sent**2, 0.0)
        if np.count_nonzero(search) < 6:
            return None
        error = np.nan_to_num(there.phase_rad - real.phase_rad) + own
        slope, _ = _without_plane(error, pupil_m, search)
        last = seen
        if np.linalg.norm(slope) < SETTLED * k:
            break
        sines = seen / np.sqrt(1 + seen @ seen) - slope / k
        if not sines @ sines < 1:  # the light is seen along no direction at all
            return None
        seen = sines / np.sqrt(1 - sines @ sines)
    if np.count_nonzero(amount) < 6:
        return None
    return Light(last, error, np.nan_to_num(there.pupil_m), pupil_m, amount)


def _zone(
    nominal: Bench, bench: Bench, x: Array, own: Array, tangent: Array, wavelength_m: float, noll: Sequence[int],
    coefficients_rad: Array,
) -> Array:  # fmt: skip
    light = light_of_spot(nominal, bench, x, own, tangent, wavelength_m)
    if light is None:
        return np.full(len(coefficients_rad), np.nan)
    estimates = np.zeros((len(coefficients_rad), len(x)))
    if len(noll):
        local = light.nominal_m / (nominal.pupil_diameter_m / 2)
        estimates = coefficients_rad @ zernike(noll, local[:, 0], local[:, 1])
    amount = light.amount
    rests = [_without_plane(light.error_rad - estimated, light.nominal_m, amount)[1] for estimated in estimates]
    return np.array([np.sqrt(np.sum(amount * rest**2) / amount.sum()) for rest in rests])


def panel_points(panel: Panel, truth: Mapping[str, Any], wavelength_m: float) -> tuple[Array, Array]:
    """Return an even grid of points of the panel (n, 2), and the phase of its own path there (n,)."""
    half = np.asarray(panel.half_size_m)
    line = [(np.arange(n) + 0.5) / n * 2 - 1 for n in GRID]
    x = np.stack(np.meshgrid(line[0] * half[0], line[1] * half[1]), axis=-1).reshape(-1, 2)
    own = np.zeros(len(x))
    for index, rms_nm in truth.get("slm", {}).get("flatness_nm") or []:
        local = x / np.hypot(*half)
        own += 2 * np.pi / wavelength_m * rms_nm * 1e-9 * zernike([index], local[:, 0], local[:, 1])[0]
    return x, own


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
