"""The warped engine's plan: how the panel is cut in patches, on which grid, and what mask the pupil is.

The grid is even in sight coordinates (`sight`), where the pupil is the spectrum; it reaches a little beyond the panel.
Each patch of it has its own bilinear form of the phases (`warp`), so a patch is one non-uniform Fourier transform.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from holocal.errors import SamplingError
from holocal.hologram.encode.blocks import in_blocks
from holocal.hologram.footprint import EDGE_M, transmission
from holocal.hologram.phase_model import wanted_phase
from holocal.hologram.scenes.points import Aperture
from holocal.hologram.settings import HologramSettings, Warped
from holocal.hologram.sight import Sight, sight
from holocal.hologram.warp import Box, Depth, Warp, fit_warp
from holocal.optics.bench import Array
from holocal.optics.phase_function import VirtualPoints, pupil_rim
from holocal.optics.raytrace import connect

_MOST_SAMPLES = 2**26  # 0.5 GiB of complex64; the 4K panel takes 6 million, 21 with a pupil of 8 mm
_SPARE = 24  # samples beyond the panel on every side: the mask's edge spreads light over a few
_FINE_RAD = 0.08  # below this, patches' borders and the mask's edge count too
_FIT_SHARE, _FINE_SHARE = 0.8, 0.55  # of the wanted error is the fit's; transforms, mask and borders have the rest
# Widest patch (x, y), metres: 3 x 2 on the 4K panel. Wider ones need a finer grid, and are slower at any accuracy.
_WIDEST_M = (5.0e-3, 4.1e-3)
_FAR_OFF, _HOPELESS = 5.0, 2.0  # times the limit: the finest cut leaves an eighth of the coarsest's error at 4K
_FINER = (1.0, 1.34, 1.67, 2.0, 2.67, 3.34, 4.0, 5.34, 6.67, 9.0)


@dataclass(frozen=True)
class SightGrid:
    """`rows` x `columns` samples of sight coordinates, row 0 at the largest s_y.

    `first` is s of the sample at row 0, column 0; `step` (x, y) is positive, rows run down.
    """

    rows: int
    columns: int
    first: tuple[float, float]
    step: tuple[float, float]

    @property
    def s_x(self) -> Array:
        """(columns,) ascending."""
        return np.asarray(self.first[0] + self.step[0] * np.arange(self.columns), np.float64)

    @property
    def s_y(self) -> Array:
        """(rows,) descending."""
        return np.asarray(self.first[1] - self.step[1] * np.arange(self.rows), np.float64)

    def frequencies(self) -> tuple[Array, Array]:
        """Return u_x (columns,) and u_y (rows,) of the grid's discrete transform, radians per unit of s."""
        return (
            np.asarray(2 * np.pi * np.fft.fftfreq(self.columns, self.step[0]), np.float64),
            np.asarray(-2 * np.pi * np.fft.fftfreq(self.rows, self.step[1]), np.float64),
        )


@dataclass(frozen=True)
class Patch:
    """A rectangle of the grid: its rows and columns, and its sight coordinates."""

    rows: slice
    columns: slice
    box: Box

    @property
    def outline(self) -> Array:
        """Corners (4, 2) in sight coordinates."""
        return np.asarray(self.box.centre + self.box.half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))


@dataclass(frozen=True)
class Layout:
    """The patches of a setting, the grid they lie on, and the curvature C = du / ds (2, 2) of a point's phase there."""

    cut: tuple[int, int]
    sight: Sight
    grid: SightGrid
    patches: tuple[Patch, ...]
    curvature: Array


@dataclass(frozen=True)
class PatchForm:
    """What a patch shows at a depth: points inside `seen`, a convex outline (n, 2) of tangents, by a bilinear form."""

    patch: Patch
    seen: Array
    warp: Warp


@dataclass(frozen=True)
class WarpedPlan:
    """The bilinear forms, for points at one depth, of the patches that show any of the field.

    `error_rad` is what they leave of the phase, rms over all rays through the pupil.
    """

    layout: Layout
    depth: Depth
    forms: tuple[PatchForm, ...]

    @property
    def error_rad(self) -> float:
        """Rms phase error over all rays through the pupil, radians."""
        weight = sum(form.warp.weight for form in self.forms)
        return float(np.sqrt(sum(form.warp.square_rad2 for form in self.forms) / max(weight, 1e-300)))


@lru_cache(maxsize=4)
def accurate_plan(settings: HologramSettings) -> WarpedPlan:
    """Return the coarsest plan, for points at infinity, whose phase error is within the setting's accuracy."""
    accuracy = accuracy_of(settings)
    limit = accuracy * (_FIT_SHARE if accuracy >= _FINE_RAD else _FINE_SHARE)
    error, found = np.inf, cuts(settings)
    for cut in found:
        plan = warped_plan(settings, Depth(0.0), cut)
        error = plan.error_rad
        if error <= limit:
            return plan
        # far off: one of the finest patches tells at once what all cuts on the way there take a minute for
        if cut == found[0] and error > _FAR_OFF * limit:
            error = _middle_error(settings, found[-1])
            if error > _HOPELESS * limit:
                break
    raise SamplingError(
        f"The phase functions are {error:.2g} rad (rms) from a bilinear form in the finest patches, not {limit:.2g}.",
        why="" if settings.wavefront is None else "The wavefront correction may be too strong for this method.",
        fix="Ask for a larger --accuracy, or use --method direct.",
        measured=error,
        limit=limit,
    )


def _middle_error(settings: HologramSettings, cut: tuple[int, int]) -> float:
    """Return the rms phase error of the patch in the panel's middle, in a cut of the panel."""
    seen_as = _sight(settings)
    half = np.asarray(seen_as.to_panel.half) / cut
    box = Box(np.asarray(seen_as.to_panel.centre) + half * (1 - np.asarray(cut) % 2), half)
    form = _form(settings, seen_as, Depth(0.0), Patch(slice(0, 0), slice(0, 0), box))
    return 0.0 if form is None else float(np.sqrt(form.warp.square_rad2 / max(form.warp.weight, 1e-300)))


@lru_cache(maxsize=32)
def warped_plan(settings: HologramSettings, depth: Depth, cut: tuple[int, int]) -> WarpedPlan:
    """Return the plan of a given cut (columns, rows) of the panel, for points at one depth."""
    made = layout(settings, cut)
    forms: list[PatchForm | None] = [None] * len(made.patches)

    def fit(part: slice) -> None:
        for i in range(part.start, part.stop):
            forms[i] = _form(settings, made.sight, depth, made.patches[i])

    in_blocks(fit, len(forms), 1)
    return WarpedPlan(made, depth, tuple(form for form in forms if form is not None))


def _form(settings: HologramSettings, seen_as: Sight, depth: Depth, patch: Patch) -> PatchForm | None:
    """Return a patch's bilinear form, or None where it shows nothing of the field."""
    limit = np.tan(np.asarray(settings.fov_rad) / 2)
    seen = visible_field(settings, seen_as.panel(patch.outline), depth)
    low, high = np.maximum(seen.min(axis=0), -limit), np.minimum(seen.max(axis=0), limit)
    if not np.all(low < high):
        return None
    bounds = ((float(low[0]), float(high[0])), (float(low[1]), float(high[1])))
    return PatchForm(patch, seen, fit_warp(settings, seen_as, depth, bounds, patch.box))


def accuracy_of(settings: HologramSettings) -> float:
    """Return the wavefront error that the settings ask for, radians."""
    return settings.method.accuracy_rad if isinstance(settings.method, Warped) else Warped().accuracy_rad


def cuts(settings: HologramSettings) -> list[tuple[int, int]]:
    """Return cuts (columns, rows) of the panel, coarse to fine; the error falls with the patches' area."""
    least = [2 * half / widest for half, widest in zip(settings.panel.half_size_m, _WIDEST_M, strict=True)]
    found = [(max(1, int(np.ceil(least[0] * f))), max(1, int(np.ceil(least[1] * f)))) for f in _FINER]
    return sorted(set(found))


@lru_cache(maxsize=8)
def layout(settings: HologramSettings, cut: tuple[int, int]) -> Layout:
    """Return the patches of a cut, with the coarsest grid on which no light of theirs aliases into the pupil.

    A patch shows the points that any of its samples sends through the pupil. Seen from its other end, such a point's
    light lies beyond the pupil by as much as the patch is wide: the grid holds that too.
    """
    seen_as = _sight(settings)
    centre, half = np.asarray(seen_as.to_panel.centre), np.asarray(seen_as.to_panel.half)
    size = half / cut
    boxes = [
        (row, column, Box(centre - half + size * (2 * column + 1, 2 * (cut[1] - row) - 1), size))
        for row in range(cut[1])
        for column in range(cut[0])
    ]
    nowhere = slice(0, 0)
    rim = pupil_rim(2 * (seen_as.pupil_radius_m + EDGE_M), 64)
    inside = np.abs(_frequency_of(seen_as, rim)).max(axis=0)
    reach = np.max([_reach(settings, seen_as, Patch(nowhere, nowhere, box)) for _, _, box in boxes], axis=0)
    grid = _grid(seen_as, np.maximum(reach, inside), inside)
    rows = np.linspace(0, grid.rows, cut[1] + 1).round().astype(int)
    columns = np.linspace(0, grid.columns, cut[0] + 1).round().astype(int)
    patches = tuple(
        Patch(slice(int(rows[r]), int(rows[r + 1])), slice(int(columns[c]), int(columns[c + 1])), box)
        for r, c, box in boxes
    )
    return Layout(cut, seen_as, grid, patches, _curvature(settings, seen_as))


@lru_cache(maxsize=8)
def _sight(settings: HologramSettings) -> Sight:
    return sight(settings)


def _grid(seen_as: Sight, reach: Array, inside: Array) -> SightGrid:
    """Return the grid over the sight rectangle whose sampling frequency exceeds `reach` + `inside`, radians per s."""
    half, centre = np.asarray(seen_as.to_panel.half), np.asarray(seen_as.to_panel.centre)
    step = 2 * np.pi / (1.01 * (reach + inside))
    samples = float(np.prod(2 * half / step + 2 * _SPARE))
    if not samples <= _MOST_SAMPLES:  # NaN too
        raise SamplingError(
            f"The panel's light needs {samples:.3g} samples to reach the pupil without aliasing; "
            f"the limit is {_MOST_SAMPLES:.3g}.",
            fix="Check the bench's misalignment, the pupil's diameter and the wavelength.",
            measured=samples,
            limit=_MOST_SAMPLES,
        )
    columns, rows = (
        scipy.fft.next_fast_len(int(np.ceil(2 * h / d)) + 2 * _SPARE) for h, d in zip(half, step, strict=True)
    )
    count = np.array([columns, rows])
    step = 2 * half / (count - 2 * _SPARE)
    first = centre + np.array([-1, 1]) * (count - 1) / 2 * step
    return SightGrid(rows, columns, (float(first[0]), float(first[1])), (float(step[0]), float(step[1])))


def visible_field(settings: HologramSettings, slm_m: Array, depth: Depth) -> Array:
    """Return the convex outline (n, 2) of the tangents at which panel points (k, 2) show points of a depth.

    With a margin: where a patch drops a point that its neighbour still has, the point's light ends abruptly, and what
    that diffracts into the pupil falls with the distance from the rim. 8 % leave 0.04 of the field, 100 % 0.01.
    """
    margin = 1.08 if accuracy_of(settings) >= _FINE_RAD else 2.0
    rim = pupil_rim(settings.bench.pupil_diameter_m * margin, 24)
    found = connect(settings.bench, slm_m[:, None], rim, gaze_rad=settings.gaze_rad).field_tan
    found = (found + rim * depth.inverse_m).reshape(-1, 2)  # the point's direction is taken from the pupil's centre
    return np.asarray(found[ConvexHull(found).vertices])


def inside_outline(points: Array, outline: Array) -> NDArray[np.bool_]:
    """Return which points (n, 2) lie in a convex outline (k, 2): between its lower and its upper chain."""
    left, right = int(np.argmin(outline[:, 0])), int(np.argmax(outline[:, 0]))
    turned = np.roll(outline, -left, axis=0)
    last = (right - left) % len(outline)
    one, other = turned[: last + 1], np.concatenate([turned[last:], turned[:1]])[::-1]
    first, second = (np.interp(points[:, 0], c[:, 0], c[:, 1], left=np.nan, right=np.nan) for c in (one, other))
    with np.errstate(invalid="ignore"):
        return np.asarray((points[:, 1] >= np.minimum(first, second)) & (points[:, 1] <= np.maximum(first, second)))


def _reach(settings: HologramSettings, seen_as: Sight, patch: Patch) -> Array:
    """Return the largest |u| along (x, y), at a patch's corners, of the points that it shows from infinity."""
    slm = seen_as.panel(patch.outline)
    seen = visible_field(settings, slm, Depth(0.0))
    found = wanted_phase(settings, VirtualPoints.at(seen[:, None]), slm, steps=4)
    return np.asarray(np.abs(found.pupil_m).reshape(-1, 2).max(axis=0) * seen_as.wavenumber)


def _frequency_of(seen_as: Sight, pupil_m: Array) -> Array:
    """Return u (n, 2) of pupil points (n, 2): q(u) inverted by a few fixed-point steps from u = k q."""
    u = seen_as.wavenumber * pupil_m
    for _ in range(8):
        u = u + seen_as.wavenumber * (pupil_m - seen_as.pupil(u))
    return np.asarray(u)


def _curvature(settings: HologramSettings, seen_as: Sight) -> Array:
    """Return the mean of du / ds (2, 2) over rays through the pupil: how a point's frequency runs over the panel."""
    half, centre = np.asarray(seen_as.to_panel.half), np.asarray(seen_as.to_panel.centre)
    t = np.linspace(-0.8, 0.8, 5)
    s = np.stack(np.meshgrid(t * half[0], t * half[1]), axis=-1).reshape(-1, 2) + centre
    rim = np.concatenate([pupil_rim(1.4 * seen_as.pupil_radius_m, 8), [[0.0, 0.0]]])
    slm = seen_as.panel(s)
    field = connect(settings.bench, slm[:, None], rim, gaze_rad=settings.gaze_rad).field_tan
    points = VirtualPoints.at(field)
    change = np.empty((2, 2))
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = 1e-3
        ahead, behind = (
            wanted_phase(settings, points, seen_as.panel(s + sign * step)[:, None], steps=4).pupil_m for sign in (1, -1)
        )
        change[:, axis] = np.mean((ahead - behind).reshape(-1, 2), axis=0) / 2e-3
    return seen_as.wavenumber * (change + change.T) / 2


def pupil_mask(made: Layout, diameter_m: float, aperture: Aperture | None = None) -> NDArray[np.complex64]:
    """Return the factor of the grid's spectrum, (rows, columns), that gives every point its footprint.

    A mask T(u) of the spectrum does not simply multiply a chirped wave by T: what comes out at s is
    exp(-(i / 2) C : dd) T at the wave's frequency there, the pupil's edge diffracted on its way to the panel. The
    footprint is to be T itself, so the mask is exp(+(i / 2) C : dd) T, which two transforms make.
    """
    u_x, u_y = made.grid.frequencies()
    wanted = np.zeros((len(u_y), len(u_x)), np.complex64)
    reach = 1.4 * made.sight.pupil_radius_m * made.sight.wavenumber
    rows, columns = np.flatnonzero(np.abs(u_y) < reach), np.flatnonzero(np.abs(u_x) < reach)
    pupil = made.sight.pupil_grid(u_x[columns], u_y[rows])
    wanted[np.ix_(rows, columns)] = transmission(pupil, diameter_m, aperture)
    s_x, s_y = (
        np.fft.fftfreq(count, 1 / count) * step * sign
        for count, step, sign in ((len(u_x), made.grid.step[0], 1), (len(u_y), made.grid.step[1], -1))
    )
    c = made.curvature
    spread = scipy.fft.ifft2(wanted, workers=2, overwrite_x=True)
    spread *= np.exp(-0.5j * c[0, 0] * s_x**2).astype(np.complex64)
    spread *= np.exp(-0.5j * c[1, 1] * s_y**2).astype(np.complex64)[:, None]
    if abs(c[0, 1]) * np.abs(s_x).max() * np.abs(s_y).max() > 1e-3:
        for row, y in enumerate(s_y):
            spread[row] *= np.exp(-1j * c[0, 1] * y * s_x).astype(np.complex64)
    return np.asarray(scipy.fft.fft2(spread, workers=2, overwrite_x=True), np.complex64)


def forget_plans() -> None:
    """Throw away all plans: the next is traced from nothing."""
    for kept in (accurate_plan, warped_plan, layout, _sight):
        kept.cache_clear()
