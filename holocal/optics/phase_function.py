"""What the panel must show for one virtual point: by its path length, and by a fit to the slopes of its rays.

For a virtual point p and a pupil point q the ray through both is traced away from the eye, over the mirror, to the
panel point x (thesis 3.1; docs/physics.md 3). With L = |q..mirror| + |mirror..x| and R = |p - q|,

    phi_p(x) = -k (L + |p| - R),        d phi_p / dx = k sin(alpha),

alpha being the angle of the ray that *leaves* the panel. |p|, the distance from the pupil's centre, is a constant of
the point; with it the phase stays finite as the point goes to infinity, where |p| - R becomes q . direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.optics.bench import Array, Bench
from holocal.optics.raytrace import Rays, landing_error, newton_step, trace_to_slm
from holocal.optics.zernike import zernike, zernike_gradient

NOLL_THESIS = 10  # thesis 3.1: N = 10 is below the diffraction limit
_WIDEST_TAN = 1e6  # 0.2 seconds of arc from a right angle
_MORE_STEPS = 12  # of Newton's search, while a ray through the pupil is not found
_FARTHEST_M = 1.0  # a search that runs away stops here: far outside any mirror
FAN_THESIS = 66  # thesis 3.1: 66 by 66 rays fill the pupil


@dataclass(frozen=True)
class VirtualPoints:
    """Virtual points: where the eye is to see light come from.

    `field_tan` (..., 2) are the tangents of their direction in the pupil's frame P, seen from the pupil's centre;
    `distance_m` (...) is measured from there too, positive in front of the eye, and may be infinite.
    """

    field_tan: Array
    distance_m: Array

    @classmethod
    def at(cls, field_tan: Array, distance_m: float | Array = np.inf) -> VirtualPoints:
        """Return points at tangents (..., 2) and one distance, or one each."""
        tangents = np.asarray(field_tan, np.float64)
        distance = np.broadcast_to(np.asarray(distance_m, np.float64), tangents.shape[:-1])
        if not (np.all(np.abs(tangents) <= _WIDEST_TAN) and np.all(distance > 0)):  # NaN too
            raise InputError(
                f"A virtual point needs tangents within {_WIDEST_TAN:g} and a distance above 0 m (infinity is one).",
                measured=float(np.min(distance, initial=np.inf)),
                limit=0.0,
            )
        return cls(tangents, distance)

    @property
    def direction(self) -> Array:
        """Unit directions in P, (..., 3)."""
        local = np.concatenate([self.field_tan, np.ones((*self.field_tan.shape[:-1], 1))], axis=-1)
        return np.asarray(local / np.linalg.norm(local, axis=-1, keepdims=True))


def path_lead(points: VirtualPoints, pupil_m: Array) -> Array:
    """Return |p| - |p - q| in metres, (...), for pupil points q (..., 2) in P.

    Written as (2 p.q - |q|^2) / (|p| + |p - q|), in units of |p|: nothing large is subtracted at any distance, and at
    infinity it is q . direction.
    """
    inverse = 1.0 / points.distance_m
    along = np.sum(points.direction[..., :2] * pupil_m, axis=-1)
    square = np.sum(pupil_m * pupil_m, axis=-1)
    ratio = np.sqrt(np.maximum(1.0 - 2.0 * along * inverse + square * inverse**2, 0.0))
    return np.asarray((2.0 * along - square * inverse) / (1.0 + ratio))


def trace_points(
    bench: Bench, points: VirtualPoints, pupil_m: Array, gaze_rad: tuple[float, float] = (0.0, 0.0)
) -> Rays:
    """Trace the rays of virtual points through pupil points (..., 2), broadcast together, to the panel."""
    sideways = np.concatenate([pupil_m, np.zeros((*pupil_m.shape[:-1], 1))], axis=-1)
    local = points.direction - sideways / points.distance_m[..., None]  # p - q in units of |p|
    local = local / np.linalg.norm(local, axis=-1, keepdims=True)
    origin = bench.pupil_points(pupil_m, gaze_rad)
    return trace_to_slm(bench, origin, local @ bench.pupil_axes(gaze_rad).T)


def traced_phase(points: VirtualPoints, pupil_m: Array, rays: Rays, *, wavelength_m: float) -> Array:
    """Return phi at the rays' landing points, (...) radians, from the path length (docs/physics.md 3)."""
    path = rays.to_mirror_m + rays.from_mirror_m + path_lead(points, pupil_m)
    return np.asarray(-2 * np.pi / wavelength_m * path)


def pupil_grid(diameter_m: float, count: int = FAN_THESIS) -> Array:
    """Return the points of a count x count grid that lie in the pupil, (n, 2) metres in P.

    The grid's outermost points touch the rim.
    """
    side = np.linspace(-diameter_m / 2, diameter_m / 2, count)
    grid = np.stack(np.meshgrid(side, -side), axis=-1).reshape(-1, 2)
    return np.asarray(grid[np.hypot(grid[:, 0], grid[:, 1]) <= diameter_m / 2 * (1 + 1e-12)])


def pupil_rim(diameter_m: float, count: int = 256) -> Array:
    """Return points on the pupil's rim, (count, 2) metres in P, anticlockwise from +x."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1) * diameter_m / 2)


@dataclass(frozen=True)
class PhaseFunctions:
    """Phase functions as Zernike series (thesis eq. 9), one per virtual point.

    `centre_m` (..., 2) and `radius_m` (...) are the disc on the panel, in S; `coefficients_rad` (..., N) belong to Noll
    1..N on it.
    """

    centre_m: Array
    radius_m: Array
    coefficients_rad: Array

    def _local(self, slm_m: Array) -> tuple[tuple[int, ...], Array, Array]:
        local = (np.asarray(slm_m) - self.centre_m) / self.radius_m[..., None]
        return tuple(range(1, self.coefficients_rad.shape[-1] + 1)), local[..., 0], local[..., 1]

    def phase(self, slm_m: Array) -> Array:
        """Return the phase, (...) radians, at panel points (..., 2) broadcast against the points."""
        return np.asarray(np.sum(self.coefficients_rad * np.moveaxis(zernike(*self._local(slm_m)), 0, -1), axis=-1))

    def slope(self, slm_m: Array) -> Array:
        """Return the gradient, (..., 2) radians per metre."""
        gradient = np.moveaxis(zernike_gradient(*self._local(slm_m)), 0, -2)
        return np.asarray(np.sum(self.coefficients_rad[..., None] * gradient, axis=-2) / self.radius_m[..., None])

    def for_samples(self) -> PhaseFunctions:
        """Return the same with an axis for samples before the last: points (n,) against panel points (n, k, 2)."""
        return PhaseFunctions(
            self.centre_m[..., None, :], self.radius_m[..., None], self.coefficients_rad[..., None, :]
        )

    def __getitem__(self, index: int | slice | NDArray[np.intp]) -> PhaseFunctions:
        return PhaseFunctions(self.centre_m[index], self.radius_m[index], self.coefficients_rad[index])


def fit_slopes(rays: Rays, *, wavelength_m: float, terms: int = NOLL_THESIS, weighted: bool = True) -> PhaseFunctions:
    """Return the Zernike series whose gradient is nearest to the slopes of the rays leaving the panel.

    Thesis eq. 7 to 9: minimum-norm least squares, so the piston, which no slope sees, comes out as 0. The disc is
    centred on the footprint's bounding box and reaches its farthest ray.

    `weighted` measures slopes by I - r r^T (1 - rho^2 along the radius, 1 across): Zernike gradients are orthogonal in
    that metric, with squared norm n (n + 2) (integrate the Zernike equation by parts). Terms left out of the series
    then do not leak into those kept, and N = 10 leaves 0.048 rad rms of path length at worst on the thesis's bench
    where the thesis's plain fit (`weighted=False`) leaves 0.076.

    Parameters
    ----------
    rays
        One fan per virtual point: the last axis of its (..., n) arrays runs over the fan.
    """
    low, high = rays.landing_m.min(axis=-2), rays.landing_m.max(axis=-2)
    centre = (low + high) / 2
    offset = rays.landing_m - centre[..., None, :]
    radius = np.linalg.norm(offset, axis=-1).max(axis=-1)
    local = offset / radius[..., None, None]
    gradient = zernike_gradient(tuple(range(1, terms + 1)), local[..., 0], local[..., 1])
    matrix = np.moveaxis(gradient, 0, -1) / radius[..., None, None, None]
    slopes = -2 * np.pi / wavelength_m * rays.direction[..., :2]  # light leaves the panel against the trace
    if weighted:
        root = _metric_root(local)
        matrix, slopes = root @ matrix, (root @ slopes[..., None])[..., 0]
    matrix = matrix.reshape(*matrix.shape[:-3], -1, terms)
    slopes = slopes.reshape(*slopes.shape[:-2], -1)
    inverse = np.linalg.pinv(matrix, rcond=1e-12)
    return PhaseFunctions(centre, radius, np.asarray((inverse @ slopes[..., None])[..., 0]))


def _metric_root(local: Array) -> Array:
    """Return the square root of I - r r^T, (..., 2, 2), at points (..., 2) of the unit disc."""
    square = np.sum(local * local, axis=-1)
    radial = np.sqrt(np.maximum(1.0 - square, 0.0))
    scale = -1.0 / (1.0 + radial)  # (radial - 1) / square, without the 0 / 0 at the centre
    return np.asarray(np.eye(2) + scale[..., None, None] * local[..., :, None] * local[..., None, :])


def phase_functions(
    bench: Bench,
    points: VirtualPoints,
    *,
    wavelength_m: float,
    gaze_rad: tuple[float, float] = (0.0, 0.0),
    terms: int = NOLL_THESIS,
    fan: int = FAN_THESIS,
) -> PhaseFunctions:
    """Return the phase functions of virtual points (n,): slopes fitted, piston from the path length.

    The piston makes the mean over the fan equal to that of the path length, so phases of different points compare.
    """
    pupil = pupil_grid(bench.pupil_diameter_m, fan)
    each = VirtualPoints(points.field_tan[..., None, :], points.distance_m[..., None])
    rays = trace_points(bench, each, pupil, gaze_rad)
    if not np.all(rays.valid):
        raise InputError(
            f"{int(np.sum(~rays.valid))} of {rays.valid.size} rays of the virtual points miss the mirror.",
            fix="Use a smaller field or points farther away.",
        )
    fitted = fit_slopes(rays, wavelength_m=wavelength_m, terms=terms)
    spread = fitted.for_samples()
    exact = traced_phase(each, pupil, rays, wavelength_m=wavelength_m)
    fitted.coefficients_rad[..., 0] += np.mean(exact - spread.phase(rays.landing_m), axis=-1)
    return fitted


@dataclass(frozen=True)
class ExactPhase:
    """The phase of a point at given panel points, by path length.

    `phase_rad` (...), `pupil_m` (..., 2) where the ray crosses the pupil's plane in P (the footprint is where its
    length is at most the pupil's radius), `error_m` (...) how far from the panel point the ray lands.
    """

    phase_rad: Array
    pupil_m: Array
    error_m: Array


def _lost(bench: Bench, pupil_m: Array, error_m: Array) -> NDArray[np.bool_]:
    """Return which rays cross the pupil, or nearly, without landing where they should."""
    return np.asarray((np.linalg.norm(pupil_m, axis=-1) < bench.pupil_diameter_m) & ~(error_m < 1e-9))


def exact_phase(
    bench: Bench,
    points: VirtualPoints,
    slm_m: Array,
    *,
    wavelength_m: float,
    gaze_rad: tuple[float, float] = (0.0, 0.0),
    steps: int = 6,
) -> ExactPhase:
    """Return phi of points (...) at panel points (..., 2), broadcast together: Newton's search for the pupil point.

    It starts from the ideal image of the panel at the eye's rotation centre. Inside the thesis's field and footprint
    the rays land within 1e-12 m. `error_m` is infinite where the ray misses the mirror or the panel's plane.
    """
    relief = bench.eye_relief_m
    slm_m, tangents = np.broadcast_arrays(np.asarray(slm_m, np.float64), points.field_tan)
    inverse = (1.0 / points.distance_m)[..., None]
    pupil = (relief * tangents - slm_m / bench.magnification) / (1.0 + relief * inverse)
    pupil = np.clip(pupil, -_FARTHEST_M, _FARTHEST_M)
    # metres; a one-sided difference will do: the slope only steers, the landing decides. Through a point d in front of
    # the pupil, a step of d turns the ray by a radian: nearer than a centimetre the step must be smaller.
    eps = np.minimum(1e-6, 1e-4 / np.maximum(inverse, 1e-300))
    jacobian = np.empty((*slm_m.shape[:-1], 2, 2))
    rays = trace_points(bench, points, pupil, gaze_rad)
    for step in range(steps + _MORE_STEPS):
        if step >= steps and not np.any(_lost(bench, pupil, landing_error(rays, slm_m))):
            break
        # the map is smooth: a slope from near the solution serves the last steps; far misaligned ones need more
        if step < 2 or step >= steps:
            for j, axis in enumerate(np.eye(2)):
                moved = trace_points(bench, points, pupil + axis * eps, gaze_rad).landing_m
                jacobian[..., j] = (moved - rays.landing_m) / eps
        pupil = np.clip(pupil + newton_step(jacobian, slm_m - rays.landing_m), -_FARTHEST_M, _FARTHEST_M)
        rays = trace_points(bench, points, pupil, gaze_rad)
    error = landing_error(rays, slm_m)
    return ExactPhase(traced_phase(points, pupil, rays, wavelength_m=wavelength_m), pupil, error)
