"""Centres of dots, each fitted with a soft-edged elliptical disc on a sloping ground.

One family holds flat discs and round spots: S = 1 / (1 + exp(-k (1 - q) / 2)), where q = 1 on the edge. A large k is a
printed disc, k = 2 nearly a Gaussian. The centre is an odd parameter of an even profile, so that an edge of another
form than the model's does not move it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]

CHUNK = 192  # dots at a time: their windows stay in the cache
THREADS = 2
PRIOR = (0.15, 0.10, 0.10, 0.35)  # standard deviations of log radius, two ellipticities, log edge about the neighbours'
SOFTEST, SHARPEST = 0.7, 60.0  # edges k
GATE = 3.0  # noise deviations beyond which a pixel counts less


@dataclass(frozen=True)
class Shapes:
    """What dots look like, one value each: `radius_px`, `ellipticity` (n, 2), `edge` (sharpness k, no unit)."""

    radius_px: Array
    ellipticity: Array
    edge: Array

    def some(self, chosen: NDArray[np.int64]) -> Shapes:
        """Return the shapes of some dots."""
        return Shapes(self.radius_px[chosen], self.ellipticity[chosen], self.edge[chosen])


@dataclass(frozen=True)
class DiscFits:
    """Fitted dots.

    `centre_px` (n, 2) as (x, y); `variance_px2` (n,) of the centre, mean of both axes; `shapes`; `amplitude` (n,) the
    dot's step against its ground, in the image's unit and signed; `ground` (n,); `residual` (n,) the rms of what the
    model leaves, in the image's unit; `further_px` (n,) how far one more iteration would move the centre.
    """

    centre_px: Array
    variance_px2: Array
    shapes: Shapes
    amplitude: Array
    ground: Array
    residual: Array
    further_px: Array

    @property
    def misfit(self) -> Array:
        """What the model leaves (n,), as a share of the dot's step."""
        return self.residual / np.maximum(np.abs(self.amplitude), 1e-12)

    def bettered(self, chosen: NDArray[np.int64], other: DiscFits) -> DiscFits:
        """Return the fits with others in the place of some, where those fit better."""
        better = other.misfit < self.misfit[chosen]
        into = chosen[better]

        def mixed(mine: Array, new: Array) -> Array:
            out = mine.copy()
            out[into] = new[better]
            return out

        shapes = Shapes(
            mixed(self.shapes.radius_px, other.shapes.radius_px),
            mixed(self.shapes.ellipticity, other.shapes.ellipticity),
            mixed(self.shapes.edge, other.shapes.edge),
        )
        return DiscFits(
            mixed(self.centre_px, other.centre_px),
            mixed(self.variance_px2, other.variance_px2),
            shapes,
            mixed(self.amplitude, other.amplitude),
            mixed(self.ground, other.ground),
            mixed(self.residual, other.residual),
            mixed(self.further_px, other.further_px),
        )


def fit_discs(
    image: Single,
    start_px: Array,
    *,
    shapes: Shapes,
    window_px: Array,
    opacity: float,
    iterations: int,
    rough: bool = False,
) -> DiscFits:
    """Return the discs fitted at starting places.

    Parameters
    ----------
    image
        (height, width), linear in light.
    start_px
        (n, 2), (x, y) within half a radius of the centres.
    shapes
        What the neighbours look like: where the fit starts, and its prior. It matters only where noise does.
    window_px
        (n,) radius of the disc of pixels that is used; it must not reach the neighbouring dots.
    opacity
        Of dark dots, the share of the ground's slope that is missing within them; haze lies over them too, so that
        their contrast is no measure of it. 0 for bright dots, which add to their ground.
    iterations
        Gauss-Newton steps.
    rough
        Use every other pixel, as on a chessboard: half the time.

    Returns
    -------
    DiscFits
        Pixels outside the image do not count; a dot that is cut off is fitted by the rest of it.
    """
    reach = int(np.ceil(window_px.max())) if len(window_px) else 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = (np.hypot(x, y) <= reach) & (not rough or (x + y) % 2 == 0)
    offsets = np.stack([x[inside], y[inside]]).astype(np.int64)
    padded = np.pad(image, reach + 2, constant_values=np.nan)
    distance = np.hypot(*offsets)
    order = np.argsort(window_px, kind="stable")  # dots of like size together: small ones need few pixels
    pieces = [order[i : i + CHUNK] for i in range(0, len(order), CHUNK)]

    def fitted(piece: NDArray[np.int64]) -> Array:
        local = shapes.some(piece)
        pixels = offsets[:, distance <= window_px[piece].max()]
        return _fit_chunk(padded, reach + 2, start_px[piece], local, window_px[piece], pixels, opacity, iterations)

    table = np.zeros((len(start_px), 11))
    with ThreadPoolExecutor(THREADS) as pool:
        for piece, rows in zip(pieces, pool.map(fitted, pieces), strict=True):
            table[piece] = rows
    return DiscFits(
        centre_px=table[:, 0:2],
        variance_px2=table[:, 2],
        shapes=Shapes(table[:, 3], table[:, 4:6], table[:, 6]),
        amplitude=table[:, 7],
        ground=table[:, 8],
        residual=table[:, 9],
        further_px=table[:, 10],
    )


def _fit_chunk(
    padded: Single,
    margin: int,
    start: Array,
    shapes: Shapes,
    window: Array,
    offsets: NDArray[np.int64],
    opacity: float,
    iterations: int,
) -> Array:
    n = len(start)
    base = np.clip(np.rint(start).astype(np.int64), 0, np.array(padded.shape[::-1]) - 2 * margin - 1)
    values = padded[base[:, 1:2] + offsets[1] + margin, base[:, 0:1] + offsets[0] + margin]
    used = (np.hypot(*offsets) <= window[:, None]) & np.isfinite(values)
    values = np.where(used, values, 0).astype(np.float32)
    scale = np.maximum(np.abs(values).max(axis=1), 1e-30)
    values /= scale[:, None]
    weight = used.astype(np.float32)
    x, y = (offset.astype(np.float32)[None, :] for offset in offsets)
    count = np.maximum(used.sum(axis=1), 1)

    prior = np.column_stack([np.log(shapes.radius_px), shapes.ellipticity, np.log(shapes.edge)])
    p = np.zeros((n, 10))
    p[:, 0:2], p[:, 2:6] = start - base, prior
    near = np.hypot(x - p[:, 0:1], y - p[:, 1:2]) <= 0.6 * shapes.radius_px[:, None]
    far = ~near & used & (np.hypot(x, y) >= 1.25 * shapes.radius_px[:, None])
    middle, ground = _mean(values, near & used), _mean(values, far)
    p[:, 6] = ground
    p[:, 9] = middle - ground
    noise = np.full(n, 0.1)
    for step in range(iterations + 1):
        model, jacobian = _disc(p.astype(np.float32), x, y, opacity)
        left = (values - model) * used
        noise = np.sqrt(np.sum(weight * left**2, axis=1) / np.maximum(weight.sum(axis=1) - 10, 1) + 1e-12)
        # A stain or a neighbour in the window counts little: weights of a Student-like tail.
        weight = used / (1 + (left / (GATE * noise[:, None]).astype(np.float32)) ** 2)
        root = np.sqrt(weight)
        jacobian *= root[:, None, :]
        normal = np.matmul(jacobian, jacobian.transpose(0, 2, 1)).astype(np.float64)
        right = np.matmul(jacobian, (root * left)[..., None])[..., 0].astype(np.float64)
        for k, sigma in enumerate(PRIOR):
            precision = (noise / sigma) ** 2
            normal[:, 2 + k, 2 + k] += precision
            right[:, 2 + k] += precision * (prior[:, k] - p[:, 2 + k])
        diagonal = np.einsum("nii->ni", normal)
        diagonal += 1e-6 * diagonal + 1e-9
        if step < iterations:
            p += _held(np.linalg.solve(normal, right[..., None])[..., 0], shapes.radius_px)
            p[:, 0:2] = np.clip(p[:, 0:2], -window[:, None], window[:, None])
            p[:, 3:5] = np.clip(p[:, 3:5], -0.6, 0.6)
            p[:, 5] = np.clip(p[:, 5], np.log(SOFTEST), np.log(SHARPEST))
    inverse = np.linalg.inv(normal)
    covariance = inverse * (noise**2)[:, None, None]
    further = np.matmul(inverse[:, 0:2], right[..., None])[..., 0]
    out = np.zeros((n, 11))
    out[:, 0:2] = p[:, 0:2] + base
    out[:, 2] = (covariance[:, 0, 0] + covariance[:, 1, 1]) / 2
    out[:, 3], out[:, 4:6], out[:, 6] = np.exp(p[:, 2]), p[:, 3:5], np.exp(p[:, 5])
    out[:, 7] = p[:, 9] * scale
    out[:, 8] = p[:, 6] * scale
    out[:, 9] = np.sqrt(np.sum(used * left**2, axis=1) / count) * scale
    out[:, 10] = np.hypot(*further.T)
    return out


def _held(step: Array, radius: Array) -> Array:
    """Return a Gauss-Newton step that does not leave where the model is a good guide."""
    centre = 0.4 * radius[:, None]
    step[:, 0:2] = np.clip(step[:, 0:2], -centre, centre)
    step[:, 2] = np.clip(step[:, 2], -0.25, 0.25)
    step[:, 3:5] = np.clip(step[:, 3:5], -0.2, 0.2)
    step[:, 5] = np.clip(step[:, 5], -0.7, 0.7)
    return step


def _disc(p: Single, x: Single, y: Single, opacity: float) -> tuple[Single, Single]:
    """Return the model (n, pixels) and its derivative (n, 10, pixels)."""
    cx, cy, log_radius, e1, e2, log_edge, b0, bx, by, step = (p[:, i : i + 1] for i in range(10))
    per_radius2 = np.exp(-2 * log_radius)
    half_edge = 0.5 * np.exp(log_edge)
    dx, dy = x - cx, y - cy
    to_x, to_y = (1 + e1) * dx + e2 * dy, e2 * dx + (1 - e1) * dy
    q = (to_x * dx + to_y * dy) * per_radius2
    exponent = np.clip(half_edge * (1 - q), -30, 30)
    profile = 1 / (1 + np.exp(-exponent))
    # The light that falls there slopes; the dot takes `opacity` of the slope away about its middle.
    through = 1 - np.float32(opacity) * profile
    slope_there = bx * dx + by * dy
    slope = profile * (1 - profile) * (step - np.float32(opacity) * slope_there)
    to_q = -half_edge * slope
    jacobian = np.empty((len(p), 10, x.shape[1]), np.float32)
    jacobian[:, 0] = to_q * to_x * (-2 * per_radius2) - bx * through
    jacobian[:, 1] = to_q * to_y * (-2 * per_radius2) - by * through
    jacobian[:, 2] = to_q * q * -2
    jacobian[:, 3] = to_q * (dx * dx - dy * dy) * per_radius2
    jacobian[:, 4] = to_q * (dx * dy) * (2 * per_radius2)
    jacobian[:, 5] = slope * exponent
    jacobian[:, 6] = 1
    jacobian[:, 7] = through * dx
    jacobian[:, 8] = through * dy
    jacobian[:, 9] = profile
    return b0 + slope_there * through + step * profile, jacobian


def _mean(values: Single, where: NDArray[np.bool_]) -> Array:
    return np.asarray((values * where).sum(axis=1) / np.maximum(where.sum(axis=1), 1), np.float64)
