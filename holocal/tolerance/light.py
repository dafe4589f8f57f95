"""Light: how bright each direction is seen on a built bench, evened out at what price, and what the panel cannot reach.

Brightness is the power through the pupil per solid angle, speckle averaged out. The hologram is phase only: each point
of the panel sends all its light, shared out evenly among the directions that it serves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, RectBivariateSpline
from scipy.ndimage import binary_erosion

from holocal.estimate.map_basis import Box, chebyshev, chebyshev_slopes
from holocal.hologram.footprint import transmission
from holocal.optics.bench import Array, Bench
from holocal.optics.phase_function import VirtualPoints, trace_points
from holocal.tolerance.arrival import Arrival, arrival
from holocal.tolerance.design import FIELD, PANEL, Design, sent_light

AT_ONCE = 32  # directions, whose arrays stay in the cache
PUPIL = 27  # points along the pupil's diameter, of light traced back from the eye
FINER = 3  # parts of a cell of the field, of which the region that counts is made
FLOOR = 0.25  # of the brightest direction: darker ones are not evened out, as the procedure `uniformity` has it
EDGE = 2  # parts, 33 of 750 camera pixels: the margin that the procedure keeps from them
FEWEST = 9  # parts, of which a non-uniformity is told
FEWEST_LIT = 30  # directions of the nominal hologram, of which a picture is told


@dataclass(frozen=True)
class Brightness:
    """Brightness in the FIELD^2 seen directions.

    `value` (FIELD^2,) square metres of evenly lit panel, 0 where nothing arrives; `assigned` (FIELD^2,) what the panel
    spends on each; `lit` (FIELD^2,) the share of the pupil that is lit.
    """

    value: Array
    assigned: Array
    lit: Array

    @cached_property
    def parts(self) -> Array:
        """The brightness of the cells' parts, (FIELD * FINER, FIELD * FINER), by cubic splines."""
        return _parts(self.value)

    @cached_property
    def correctable(self) -> NDArray[np.bool_]:
        """Which parts are bright enough to be evened out, and not on the border of what is."""
        bright = (self.parts > 0) & (self.parts >= FLOOR * self.value.max())
        return np.asarray(binary_erosion(bright, iterations=EDGE, border_value=1))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which of the seen directions (FIELD^2,) lie in the correctable region."""
        return np.asarray(self.correctable[FINER // 2 :: FINER, FINER // 2 :: FINER].ravel())

    def covered(self, least: float) -> NDArray[np.bool_]:
        """Return of which parts at least a share `least` of the pupil is lit, (FIELD * FINER, FIELD * FINER)."""
        return np.asarray(_parts(self.lit) >= least)

    @property
    def nonuniformity(self) -> float:
        """Standard deviation over mean of the correctable region; NaN where there is next to none."""
        value = self.parts[self.correctable]
        return float(value.std() / value.mean()) if len(value) >= FEWEST else float("nan")


@dataclass(frozen=True)
class TrueLight:
    """The light of a hologram that was made for the built bench.

    `nyquist_use` is the highest spatial frequency that it asks of the panel in a direction that counts, over the
    panel's highest: one wave in two pixels, to both sides of the middle between two orders. `beyond_nyquist` is the
    share of the light that lies above.
    """

    brightness: Brightness
    nyquist_use: float
    beyond_nyquist: float


def of_nominal_hologram(design: Design, seen: Arrival) -> tuple[Brightness, Brightness]:
    """Return the brightness that the nominal hologram gives on a built bench: as it is, and with the picture mapped.

    As it is, the picture shows the field's own content wherever it is seen, brighter where it shrinks; mapped, it
    fills the field, with content from beyond it where need be.
    """
    light = sent_light(design)
    some = seen.lit > 0
    looked = design.seen_directions()
    if np.count_nonzero(some) < FEWEST_LIT:
        dark = np.zeros(len(looked))
        return Brightness(dark, dark, dark), Brightness(dark, dark, dark)
    denser = _denser(light.field_tan[some], seen.seen_tan[some], seen.lit[some])
    told = [seen.power[some], light.assigned[some].sum(axis=1), seen.lit[some], denser, light.field_tan[some]]
    at = np.nan_to_num(LinearNDInterpolator(seen.seen_tan[some], np.column_stack(told))(looked))
    power, assigned, lit, denser, from_tan = at[:, 0], at[:, 1], at[:, 2], at[:, 3], at[:, 4:]
    content = design.in_field(from_tan)
    return (
        Brightness(*(np.where(content, one, 0.0) for one in (power * denser, assigned * denser, lit))),
        Brightness(power, assigned, lit),
    )


def of_true_hologram(design: Design, built: Bench) -> TrueLight:
    """Return the brightness that a hologram of the built bench itself gives, by rays traced back from the eye."""
    tangents = design.seen_directions()
    rows = np.flatnonzero(_reached(design, built, tangents))
    made = np.zeros((5, len(tangents)))
    for k in range(0, len(rows), AT_ONCE):
        at = rows[k : k + AT_ONCE]
        made[:, at] = _traced_back(design, built, tangents[at])
    power, spent, share, highest, above = made
    brightness = Brightness(power, spent, share)
    inside = brightness.inside
    total = float(spent[inside].sum())
    return TrueLight(
        brightness,
        float(np.max(highest[inside], initial=0.0)),
        float(above[inside].sum()) / total if total > 0 else 0.0,
    )


def _reached(design: Design, built: Bench, tangents: Array) -> NDArray[np.bool_]:
    """Return of which directions (n, 2) the image of the pupil's square may lie on the panel, (n,)."""
    half = 0.6 * design.pupil_diameter_m
    corners = np.asarray(half * (np.indices((3, 3)).reshape(2, -1).T - 1.0), np.float64)
    rays = trace_points(built, VirtualPoints.at(tangents[:, None]), corners)
    low, high = rays.landing_m.min(axis=1), rays.landing_m.max(axis=1)
    panel = np.asarray(design.panel.half_size_m)
    return np.asarray(np.all((low < panel) & (high > -panel), axis=-1) | ~rays.valid.all(axis=-1))


def _traced_back(design: Design, built: Bench, tangents: Array) -> Array:
    """Return five rows for seen directions (n, 2), (5, n): power that arrives, what is spent on it, share of the pupil
    that is lit, the highest frequency over the panel's, and what is spent above that."""
    pupil_m, step_m = _pupil_grid(design.pupil_diameter_m)
    rays = trace_points(built, VirtualPoints.at(tangents[:, None]), pupil_m)
    landing = np.where(rays.valid[..., None], rays.landing_m, 1.0)
    on_panel, area_m2 = _on_panel(design, landing)
    through = transmission(pupil_m, design.pupil_diameter_m) ** 2
    lit = np.where(rays.valid, on_panel, 0.0) * through
    sines = -rays.direction[..., :2]
    spent = lit * area_m2 * design.beam(landing) / _shared_by(design, landing)
    use = 2 * np.abs(sines).max(axis=-1) * design.panel.pitch_m / design.wavelength_m
    return np.stack(
        [
            np.sum(spent * through * design.envelope(sines), axis=1),
            spent.sum(axis=1),
            lit.sum(axis=1) * step_m**2 / (np.pi * (design.pupil_diameter_m / 2) ** 2),
            np.max(np.where(spent > 0, use, 0.0), axis=1),
            np.sum(np.where(use > 1, spent, 0.0), axis=1),
        ]
    )


@lru_cache(maxsize=2)
def nominal_brightness(design: Design) -> Brightness:
    """Return the brightness of the bench as it is drawn."""
    return of_nominal_hologram(design, arrival(design, design.bench, sent_light(design)))[1]


def evened_out(brightness: Brightness) -> tuple[float, float]:
    """Return the non-uniformity that evening out leaves, and its price in light.

    What is left is how wrong a direction's brightness is when it is told from all others, 50 of 750 camera pixels
    away; the procedure measures every 33. The price is the factor by which the mean brightness of the correctable
    region changes: weights take light from bright directions, and the panel shares it out among all.
    """
    value = brightness.parts[brightness.correctable]
    inside = brightness.inside
    if len(value) < FEWEST or not inside.any():
        return float("nan"), 0.0
    lowest = float(value.min())
    weight = np.where(inside, np.minimum(lowest / np.maximum(brightness.value, 1e-300), 1.0), 1.0)
    spent = brightness.assigned.sum() / np.sum(weight * brightness.assigned)
    wrong = (_error_from_others() @ brightness.value)[inside] / brightness.value[inside]
    return float(np.sqrt(np.mean(wrong**2))), lowest / float(value.mean()) * float(spent)


def _parts(values: Array) -> Array:
    """Return values of the directions (FIELD^2,) in the cells' parts, (FIELD * FINER, FIELD * FINER), not below 0."""
    own, fine = np.arange(FIELD) + 0.5, (np.arange(FIELD * FINER) + 0.5) / FINER
    return np.asarray(np.maximum(RectBivariateSpline(own, own, values.reshape(FIELD, FIELD))(fine, fine), 0.0))


@lru_cache(maxsize=1)
def _error_from_others() -> Array:
    """Return the matrix (FIELD^2, FIELD^2) from values to their errors when each is interpolated from all others.

    Thin-plate splines with a linear trend; the errors of leaving one out by Rippa, doi:10.1023/A:1018975909870.
    """
    place = np.indices((FIELD, FIELD)).reshape(2, -1).T / FIELD
    distance = np.linalg.norm(place[:, None] - place, axis=-1)
    kernel = distance**2 * np.log(np.where(distance > 0, distance, 1.0))
    trend = np.column_stack([np.ones(len(place)), place])
    inverse = np.linalg.inv(np.block([[kernel, trend], [trend.T, np.zeros((3, 3))]]))[: len(place), : len(place)]
    return np.asarray(inverse / np.diag(inverse)[:, None])


def _denser(sent_tan: Array, seen_tan: Array, weight: Array) -> Array:
    """Return by how much the picture is denser than it was sent, (n,): the Jacobian d sent / d seen, by a cubic fit."""
    box = Box.around(sent_tan)
    scaled, root = box.scaled(sent_tan), np.sqrt(weight)[:, None]
    found = np.linalg.lstsq(chebyshev(scaled, 3) * root, seen_tan * root, rcond=None)[0]
    slope = np.einsum("ntj,ti->nij", chebyshev_slopes(scaled, 3), found) / box.half
    return np.asarray(1.0 / np.maximum(np.abs(np.linalg.det(slope)), 1e-3))


def _pupil_grid(diameter_m: float) -> tuple[Array, float]:
    """Return points of the pupil's plane on a square somewhat larger than the pupil, (PUPIL^2, 2), and their pitch."""
    line, step = np.linspace(-0.54 * diameter_m, 0.54 * diameter_m, PUPIL, retstep=True)
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2), float(step)


def _on_panel(design: Design, landing_m: Array) -> tuple[Array, Array]:
    """Return how much of each cell of the pupil's grid is the panel's image, and its area on the panel, (D, PUPIL^2).

    A cell that the panel's edge runs through counts in part.
    """
    grid = landing_m.reshape(-1, PUPIL, PUPIL, 2)
    down, along = np.gradient(grid, axis=1), np.gradient(grid, axis=2)
    inside = np.ones(grid.shape[:-1])
    for axis, half in enumerate(design.panel.half_size_m):
        cell = np.maximum(np.abs(down[..., axis]) + np.abs(along[..., axis]), 1e-12)
        inside *= np.clip(0.5 + (half - np.abs(grid[..., axis])) / cell, 0.0, 1.0)
    area = np.abs(down[..., 0] * along[..., 1] - down[..., 1] * along[..., 0])
    return inside.reshape(len(grid), -1), np.asarray(area.reshape(len(grid), -1))


def _shared_by(design: Design, slm_m: Array) -> Array:
    """Return the number of directions that share points of the panel (..., 2), as on the nominal bench."""
    table = sent_light(design).shared_by.reshape(PANEL[1], PANEL[0])
    at = []
    for axis, (half, count) in enumerate(zip(design.panel.half_size_m, PANEL, strict=True)):
        at.append(np.clip((slm_m[..., axis] / half + 1) * count / 2 - 0.5, 0, count - 1 - 1e-9))
    (column, x), (row, y) = ((np.floor(a).astype(np.intp), a - np.floor(a)) for a in at)
    top = table[row, column] * (1 - x) + table[row, column + 1] * x
    return np.asarray(top * (1 - y) + (table[row + 1, column] * (1 - x) + table[row + 1, column + 1] * x) * y)
