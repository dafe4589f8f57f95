"""Where the camera sees the image's points: a pattern of blobs at known places, found in a picture.

A bench out of line by 0.2 degrees moves the picture by a dozen pixels: a brightness map measured in the camera must not
be applied to the image as if the two were one. The blobs lie irregularly, so that no shift fits but the right one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

Array = NDArray[np.float64]

PER_SIDE = 9  # blobs
SIGMA_SHARE = 0.008  # of the image's width: 6 pixels of 750; a centroid then averages some hundred speckle grains
JITTER = 0.3  # of the blobs' pitch
WINDOW_SIGMAS = 3.0
BRIGHT = 0.08  # a blob below this share of the brightest is not used
MOST_TERMS = 6  # 1, x, y, xx, xy, yy


@dataclass(frozen=True)
class Registration:
    """The map between image and picture, both in pixels of the same grid (pixel centres are whole numbers).

    `to_picture` and `to_image` (terms, 2) are the coefficients of polynomials in the scaled coordinates of `scaled`;
    `shift_px` (x, y) is where the middle goes; `found` of `shown` blobs were used; `residual_px` is their rms distance
    from the fit. With fewer than three blobs the map is the identity and `found` is 0.
    """

    width: int
    height: int
    to_picture: Array
    to_image: Array
    shift_px: tuple[float, float]
    residual_px: float
    found: int
    shown: int

    def picture_to_image(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Return the image's (columns, rows) that picture points show."""
        return self._apply(self.to_image, columns, rows)

    def image_to_picture(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Return the picture's (columns, rows) where image points are seen."""
        return self._apply(self.to_picture, columns, rows)

    def _apply(self, coefficients: Array, columns: Array, rows: Array) -> tuple[Array, Array]:
        scaled = _scaled(np.stack([columns, rows], axis=-1), self.width, self.height)
        moved = _terms(scaled)[..., : len(coefficients)] @ coefficients
        return columns + moved[..., 0], rows + moved[..., 1]


def blob_places(height: int, width: int) -> Array:
    """Return the blobs' centres (81, 2), (column, row) in pixels: an irregular grid, always the same."""
    rng = np.random.default_rng(20260)
    pitch = np.array([width, height]) / PER_SIDE
    grid = np.stack(np.meshgrid(np.arange(PER_SIDE), np.arange(PER_SIDE)), axis=-1).reshape(-1, 2) + 0.5
    return np.asarray((grid + rng.uniform(-JITTER, JITTER, grid.shape)) * pitch - 0.5)


def blob_image(height: int, width: int) -> Array:
    """Return the pattern, (height, width) intensities from 0 to 1."""
    sigma = SIGMA_SHARE * width
    image = np.zeros((height, width))
    for column, row in blob_places(height, width):
        in_x = np.exp(-0.5 * ((np.arange(width) - column) / sigma) ** 2)
        in_y = np.exp(-0.5 * ((np.arange(height) - row) / sigma) ** 2)
        image += np.outer(in_y, in_x)
    return np.where(image > 1e-3, np.minimum(image, 1.0), 0.0)


def register(picture: Array) -> Registration:
    """Return the registration of a picture (height, width) of `blob_image`, its dark level subtracted."""
    height, width = picture.shape
    places = blob_places(height, width)
    sigma = SIGMA_SHARE * width
    # The speckle is averaged over a blob, and the root keeps the brightest blobs from deciding alone.
    smooth = np.sqrt(np.maximum(_blurred(picture, sigma), 0))
    shift = best_shift(smooth, np.sqrt(_blurred(blob_image(height, width), sigma)))
    predicted, used = places + shift, np.zeros(len(places), bool)
    seen = predicted
    for _ in range(3):
        seen, weight = centroids(picture, predicted, WINDOW_SIGMAS * sigma)
        used = weight > BRIGHT * np.nanmax(np.append(weight, 1e-300))
        coefficients, used = _robust(places, seen, used, width, height)
        moved = _terms(_scaled(places, width, height))[:, : len(coefficients)] @ coefficients
        predicted = places + moved
    count = int(np.count_nonzero(used))
    if count < 3:
        nothing = np.zeros((1, 2))
        return Registration(width, height, nothing, nothing, (0.0, 0.0), float("nan"), 0, len(places))
    residual = float(np.sqrt(np.mean(np.sum((seen - predicted)[used] ** 2, axis=1))))
    back = _fit(seen[used], (places - seen)[used], width, height)
    middle = _terms(np.zeros((1, 2)))[:, : len(coefficients)] @ coefficients
    return Registration(
        width,
        height,
        coefficients,
        back,
        (float(middle[0, 0]), float(middle[0, 1])),
        residual,
        count,
        len(places),
    )


def _blurred(picture: Array, sigma: float) -> Array:
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(np.asarray(picture, np.float64), sigma / 2, mode="constant"))


def best_shift(picture: Array, pattern: Array) -> Array:
    """Return the whole-pixel shift (column, row) of the pattern that correlates best with the picture.

    Up to 30 % of the field: beyond, what is left of the pattern in the picture is too little to be sure.
    """
    shape = [next_fast_len(2 * n) for n in picture.shape]
    correlation = irfft2(
        rfft2(picture - picture.mean(), shape) * np.conj(rfft2(pattern - pattern.mean(), shape)), shape
    )
    reach = [int(0.3 * n) for n in picture.shape]
    offsets = [np.r_[0 : r + 1, -r:0] for r in reach]
    near = correlation[np.ix_(*offsets)]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    return np.array([offsets[1][column], offsets[0][row]], float)


def centroids(picture: Array, near: Array, radius: float) -> tuple[Array, Array]:
    """Return the centroids (n, 2) of discs around places, and the light in each, (n,); none for discs over the edge."""
    height, width = picture.shape
    reach = int(np.ceil(radius))
    found, light = near.copy(), np.zeros(len(near))
    for i, (column, row) in enumerate(near):
        c, r = round(column), round(row)
        if not (reach <= c < width - reach and reach <= r < height - reach):
            continue
        y, x = np.mgrid[r - reach : r + reach + 1, c - reach : c + reach + 1]
        inside = np.hypot(x - column, y - row) <= radius
        values = np.where(inside, picture[r - reach : r + reach + 1, c - reach : c + reach + 1], 0.0)
        total = float(values.sum())
        if total > 0:
            found[i] = (values * x).sum() / total, (values * y).sum() / total
            light[i] = total
    return found, light


def _robust(
    places: Array, seen: Array, used: NDArray[np.bool_], width: int, height: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the fit of seen - places after leaving out blobs more than four robust deviations off it."""
    coefficients = np.zeros((1, 2))
    for _ in range(4):
        if np.count_nonzero(used) < 3:
            return np.zeros((1, 2)), used
        coefficients = _fit(places[used], (seen - places)[used], width, height)
        predicted = _terms(_scaled(places, width, height))[:, : len(coefficients)] @ coefficients
        distance = np.linalg.norm(seen - places - predicted, axis=1)
        limit = 4 * max(1.4826 * float(np.median(distance[used])), 0.2)
        kept = used & (distance <= limit)
        if np.array_equal(kept, used):
            break
        used = kept
    return coefficients, used


def _fit(at: Array, moved: Array, width: int, height: int) -> Array:
    """Return least-squares coefficients (terms, 2): a shift from 3 points, affine from 8, quadratic from 16."""
    terms = 1 if len(at) < 8 else 3 if len(at) < 16 else MOST_TERMS
    return np.asarray(np.linalg.lstsq(_terms(_scaled(at, width, height))[:, :terms], moved, rcond=None)[0])


def _scaled(pixels: Array, width: int, height: int) -> Array:
    return np.asarray((2 * pixels - np.array([width - 1, height - 1])) / max(width, height))


def _terms(scaled: Array) -> Array:
    x, y = scaled[..., 0], scaled[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
