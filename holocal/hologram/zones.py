"""Zones: groups of image points that share a wavefront up to tilt (thesis 3.1).

The table holds the phase functions (Noll 1 to 10) of fewer than 50 traced points for up to 5 x 5 zones: zone centres
and corners. A zone's points are shown by its centre's phase function; their tilt at the centre's footprint, and their
piston, come from the table by a smooth interpolation over the field.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from holocal.hologram.footprint import sample_footprint
from holocal.hologram.reference import PupilWindow, pupil_window, reference_turns
from holocal.hologram.settings import HologramSettings, Zones
from holocal.optics.bench import Array
from holocal.optics.phase_function import PhaseFunctions, VirtualPoints, phase_functions, pupil_rim, trace_points
from holocal.optics.series import Series, chebyshev_products, fit_series

OUTLINE_MARGIN = 1.15  # of the pupil: a mirror turned by 0.3 degrees moves the footprints by a tenth of their width
_CORNERS = 6  # grid lines of corners across the field when the zones themselves have fewer


@dataclass(frozen=True)
class Zone:
    """One zone: where it is, what it shows, how its points differ from its centre.

    Parameters
    ----------
    row, column
        Place in the field; row 0 is the top.
    factor_turns
        Phase of the centre's point minus the reference's, in turns, over the panel.
    shift
        Series over the zone's tangents with three values: tilt along x and y (turns per metre) and piston at
        `pivot_m` (turns), of a point relative to the centre.
    pivot_m
        Centre (2,) of the footprint's part on the panel.
    rim_m
        Outline (n, 2) of the footprints of its points together.
    band_per_m
        Largest |frequency| along (x, y) of the zone's light after division by the reference.
    bounds
        Tangents ((x low, x high), (y low, y high)) of the points it shows.
    """

    row: int
    column: int
    factor_turns: Series
    shift: Series
    pivot_m: Array
    rim_m: Array
    band_per_m: tuple[float, float]
    bounds: tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class ZonePlan:
    """All that synthesis needs for one setting; small arrays only.

    `edges_x`, `edges_y` (zones + 1) ascending tangents of the zones' borders; `zones` those whose footprint meets the
    panel; `missing` the (row, column) of the others; `traced` how many virtual points were traced.
    """

    edges_x: Array
    edges_y: Array
    zones: tuple[Zone, ...]
    missing: tuple[tuple[int, int], ...]
    reference_turns: Series
    window: PupilWindow
    traced: int

    def left_out(self) -> list[str]:
        """Return a sentence for each zone that no scene can need."""
        return [f"zone row {r + 1}, column {c + 1}: its footprint misses the panel" for r, c in self.missing]


@dataclass(frozen=True)
class PointTable:
    """Phase functions over the field: traced at some points, interpolated to any by a polynomial in the tangents."""

    traced: PhaseFunctions
    weights: Array
    half_tan: tuple[float, float]
    degree: int

    def at(self, field_tan: Array) -> PhaseFunctions:
        """Return interpolated phase functions at tangents (n, 2)."""
        values = _field_basis(field_tan, self.half_tan, self.degree) @ self.weights
        return PhaseFunctions(values[:, :2], values[:, 2], values[:, 3:])


def _field_basis(field_tan: Array, half_tan: tuple[float, float], degree: int) -> Array:
    """Return the Chebyshev products of total degree up to `degree`, (n, terms)."""
    return chebyshev_products(field_tan[:, 0] / half_tan[0], field_tan[:, 1] / half_tan[1], degree)


def zone_count(settings: HologramSettings) -> int:
    """Return how many zones lie along each side of the field."""
    return settings.method.count if isinstance(settings.method, Zones) else Zones().count


def zone_borders(settings: HologramSettings) -> tuple[Array, Array]:
    """Return the zones' borders in x and y, (zones + 1,) ascending tangents, evenly spaced like the image's pixels."""
    half = np.tan(np.asarray(settings.fov_rad) / 2)
    line = np.linspace(-1.0, 1.0, zone_count(settings) + 1)
    return line * half[0], line * half[1]


def table_points(settings: HologramSettings) -> Array:
    """Return the tangents (n, 2) of the traced points: zone centres first, rows from the top, then corners.

    Five zones or more across: the zones' inner corners, the field's four and the middles of its edges. Fewer: a grid of
    corners as fine as for five. Thesis 3.1: fewer than 50 points in all for 5 x 5; these are 49.
    """
    x, y = zone_borders(settings)
    centres = np.stack(np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1])[::-1] / 2), axis=-1).reshape(-1, 2)
    if zone_count(settings) >= 5:
        inner = np.stack(np.meshgrid(x[1:-1], y[1:-1]), axis=-1).reshape(-1, 2)
        outer = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
        outer = outer[np.any(outer != 0, axis=-1)] * (x[-1], y[-1])
        return np.concatenate([centres, inner, outer])
    lines = np.linspace(-1.0, 1.0, _CORNERS if zone_count(settings) < 4 else _CORNERS - 1)
    corners = np.stack(np.meshgrid(lines * x[-1], lines * y[-1]), axis=-1).reshape(-1, 2)
    return np.concatenate([centres, corners])


def point_table(settings: HologramSettings) -> PointTable:
    """Trace the table's points and fit how their phase functions vary over the field."""
    tangents = table_points(settings)
    traced = phase_functions(
        settings.bench,
        VirtualPoints.at(tangents, settings.depth_m),
        wavelength_m=settings.wavelength_m,
        gaze_rad=settings.gaze_rad,
    )
    x, y = zone_borders(settings)
    half, degree = (float(x[-1]), float(y[-1])), 5  # 49 points: rms 0.24 grains of tilt; degree 4 0.44, 7 0.85
    values = np.concatenate([traced.centre_m, traced.radius_m[:, None], traced.coefficients_rad], axis=1)
    weights = np.linalg.lstsq(_field_basis(tangents, half, degree), values, rcond=None)[0]
    return PointTable(traced, np.asarray(weights), half, degree)


@lru_cache(maxsize=8)
def zone_plan(settings: HologramSettings) -> ZonePlan:
    """Return the zones of a setting: traced once, kept for the next scene."""
    reference = reference_turns(settings)
    table = point_table(settings)
    x, y = zone_borders(settings)
    zones, missing = [], []
    for row in range(zone_count(settings)):
        for column in range(zone_count(settings)):
            low, high = zone_count(settings) - 1 - row, zone_count(settings) - row
            bounds = ((float(x[column]), float(x[column + 1])), (float(y[low]), float(y[high])))
            zone = _zone(settings, table, reference, row, column, bounds)
            if zone is None:
                missing.append((row, column))
            else:
                zones.append(zone)
    return ZonePlan(x, y, tuple(zones), tuple(missing), reference, pupil_window(settings), len(table.traced.radius_m))


def _zone(
    settings: HologramSettings,
    table: PointTable,
    reference: Series,
    row: int,
    column: int,
    bounds: tuple[tuple[float, float], tuple[float, float]],
) -> Zone | None:
    """Return a zone, or None where its footprint misses the panel."""
    centre = (sum(bounds[0]) / 2, sum(bounds[1]) / 2)
    half = ((bounds[0][1] - bounds[0][0]) / 2, (bounds[1][1] - bounds[1][0]) / 2)
    rim = zone_outline(settings, bounds)
    samples, area = sample_footprint(rim, settings.panel.half_size_m)
    if not len(samples):
        return None
    pivot = area @ samples
    own = table.traced[row * zone_count(settings) + column]
    factor = fit_series(
        lambda slm_m: own.phase(slm_m) / (2 * np.pi), degree=3, centre=(0.0, 0.0), half=settings.panel.half_size_m
    ) + (-reference)

    def difference(field_tan: Array) -> Array:
        return tilt_difference(table.at(field_tan), own, samples, area, pivot) / (2 * np.pi)

    shift = fit_series(difference, degree=5, centre=centre, half=half)
    return Zone(row, column, factor, shift, pivot, rim, _band(factor, shift, samples), bounds)


def zone_outline(settings: HologramSettings, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Array:
    """Return the outline (n, 2), anticlockwise, of what the footprints of all of a zone's points cover together.

    Each point is lit over its whole footprint, and a margin for the bench's misalignment; what is lit beyond it misses
    the pupil. With the centre's footprint for all points of a zone, or none of the margin on a misaligned bench,
    brightness jumps at the zones' borders (thesis figure 4.10).
    """
    corners = np.array([[x, y] for x in bounds[0] for y in bounds[1]])
    points = VirtualPoints.at(corners[:, None], settings.depth_m)
    rim = pupil_rim(settings.bench.pupil_diameter_m * OUTLINE_MARGIN)
    landing = trace_points(settings.bench, points, rim, settings.gaze_rad).landing_m.reshape(-1, 2)
    return np.asarray(landing[ConvexHull(landing).vertices])


def tilt_difference(them: PhaseFunctions, own: PhaseFunctions, samples: Array, area: Array, pivot: Array) -> Array:
    """Return best tilt (x, y; radians per metre) and piston at `pivot` (radians), (n, 3), of n points against `own`.

    Least squares over the zone's footprint (`samples` (k, 2) with weights `area`), each sample weighted by whether it
    lies in the point's own footprint too: light from elsewhere misses the pupil. The weight falls off smoothly
    (over 5 % of the radius), so that the result can be interpolated; where the two do not overlap it falls back on all.
    """
    spread = PhaseFunctions(them.centre_m[:, None], them.radius_m[:, None], them.coefficients_rad[:, None])
    phase = spread.phase(samples) - own.phase(samples)
    radius = np.linalg.norm(samples - them.centre_m[:, None], axis=-1) / them.radius_m[:, None]
    weight = area * (1e-3 + 1.0 / (1.0 + np.exp(np.minimum((radius - 0.95) / 0.05, 50.0))))
    scale = float(np.ptp(samples, axis=0).max())
    plane = np.concatenate([(samples - pivot) / scale, np.ones((len(samples), 1))], axis=1)
    normal = np.einsum("pk,ki,kj->pij", weight, plane, plane)
    right = np.einsum("pk,ki,pk->pi", weight, plane, phase)
    solved = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(solved / np.array([scale, scale, 1.0]))


def _band(factor: Series, shift: Series, samples: Array) -> tuple[float, float]:
    """Return the largest |frequency| along x and y of a zone's light over its footprint's samples, cycles per metre."""
    step = 1e-6
    found = []
    for axis in (0, 1):
        ahead, behind = samples.copy(), samples.copy()
        ahead[:, axis] += step
        behind[:, axis] -= step
        own = (factor.at(ahead) - factor.at(behind)) / (2 * step)
        corner = np.array([-1.0, 1.0])
        tilt = shift.on_grid(shift.centre[0] + corner * shift.half[0], shift.centre[1] + corner * shift.half[1])
        found.append(float(np.max(np.abs(own[:, None] + tilt[..., axis].ravel()))))
    return found[0], found[1]
