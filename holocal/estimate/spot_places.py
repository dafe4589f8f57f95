"""Where the camera sees the zones' spots: a pattern of irregular places found in a picture, and the map between."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from holocal.estimate.registration import best_shift, centroids
from holocal.optics.bench import Array

BRIGHT = 0.05  # of the brightest spot's light: a fainter one is not used for the map
ROUNDS = 4
OUTLIER_SIGMAS = 5.0
LEAST_SPREAD_PX, SURE_SPREAD_PX = 0.5, 0.05  # of centroids, of places by fitted wavefronts
# Terms of the map: a shift from 2 spots, affine from 5, quadratic from 9, cubic from 16.
TERMS = ((16, 10), (9, 6), (5, 3), (2, 1))


@dataclass(frozen=True)
class SpotPlaces:
    """The map from expected to seen places, pixels: seen = place + terms(place) @ `coefficients` (terms, 2).

    `places` (spots, 2) are from the picture's `middle` (2,). `seen` (spots, 2) is the centroid of those used, the map's
    place for the others; `used` says which; `residual_px` is the used ones' rms distance from the map; with fewer than
    two `used` nothing is known and the map is the identity.
    """

    places: Array
    seen: Array
    used: NDArray[np.bool_]
    coefficients: Array
    middle: Array
    scale_px: float
    residual_px: float

    def at(self, places: Array) -> Array:
        """Return where places (n, 2) are seen."""
        return np.asarray(places + _terms(places / self.scale_px)[:, : len(self.coefficients)] @ self.coefficients)

    def jacobian(self, places: Array) -> Array:
        """Return d seen / d place, (n, 2, 2)."""
        steps = [self.at(places + e) - self.at(places - e) for e in np.eye(2)]
        return np.stack(steps, axis=-1) / 2

    def moved(self, seen: Array, used: NDArray[np.bool_]) -> SpotPlaces:
        """Return the map from better places (spots, 2) of those that are `used`; outliers are left out."""
        middle = self.middle
        coefficients, kept = _robust(self.places / self.scale_px, seen - middle - self.places, used, SURE_SPREAD_PX)
        fitted = self.places + _terms(self.places / self.scale_px)[:, : len(coefficients)] @ coefficients + middle
        off = float(np.sqrt(np.mean(np.sum((seen - fitted)[kept] ** 2, axis=1)))) if kept.any() else float("nan")
        where = np.where(used[:, None], seen, fitted)
        return replace(self, seen=where, used=kept, coefficients=coefficients, residual_px=off)


def find_spots(picture: Array, places: Array, light: Array, sigma_px: float) -> SpotPlaces:
    """Return where spots that are expected at places (n, 2; column, row) are seen in a picture.

    Parameters
    ----------
    picture
        (height, width), dark level subtracted, hot pixels taken out.
    light
        (n,) of the spots as expected, any unit; 0 for those that are not shown.
    sigma_px
        Radius of a spot.
    """
    height, width = picture.shape
    scale = max(height, width) / 2
    pattern = np.zeros((height, width))
    shown = light > 0
    for (column, row), much in zip(places[shown], light[shown], strict=True):
        c, r = round(float(column)), round(float(row))
        if 0 <= c < width and 0 <= r < height:
            pattern[r, c] += np.sqrt(much)
    smooth = np.sqrt(np.maximum(gaussian_filter(picture, sigma_px), 0.0))
    shift = best_shift(smooth, gaussian_filter(pattern, 1.5 * sigma_px))
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    centred = places - middle
    predicted, coefficients, used = places + shift, shift[None].astype(np.float64), np.zeros(len(places), np.bool_)
    seen, residual = predicted, float("nan")
    for turn in range(ROUNDS):
        reach = (6.0 if turn == 0 else 3.0) * sigma_px
        seen, weight = centroids(picture, predicted, reach)
        used = shown & (weight > BRIGHT * np.max(np.where(shown, weight, 0.0), initial=1e-300))
        coefficients, used = _robust(centred / scale, seen - places, used)
        predicted = places + _terms(centred / scale)[:, : len(coefficients)] @ coefficients
        if used.any():
            residual = float(np.sqrt(np.mean(np.sum((seen - predicted)[used] ** 2, axis=1))))
    if np.count_nonzero(used) < 2:
        return SpotPlaces(
            centred, places, np.zeros(len(places), np.bool_), np.zeros((1, 2)), middle, scale, float("nan")
        )
    return SpotPlaces(centred, np.where(used[:, None], seen, predicted), used, coefficients, middle, scale, residual)


def _robust(
    at: Array, moved: Array, used: NDArray[np.bool_], least_px: float = LEAST_SPREAD_PX
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the fit after leaving out, worst first, what lies far off it."""
    coefficients: Array = np.zeros((1, 2))
    while np.count_nonzero(used) >= 2:
        count = next(terms for least, terms in TERMS if np.count_nonzero(used) >= least)
        # A linear map first: a false spot bends a cubic to itself.
        count = min(count, 3) if np.count_nonzero(used) > 5 and coefficients.shape[0] == 1 else count
        coefficients = np.asarray(np.linalg.lstsq(_terms(at[used])[:, :count], moved[used], rcond=None)[0], np.float64)
        off = np.linalg.norm(moved - _terms(at)[:, :count] @ coefficients, axis=1)
        spread = max(1.4826 * float(np.median(off[used])), least_px)
        worst = int(np.argmax(np.where(used, off, 0.0)))
        if off[worst] > OUTLIER_SIGMAS * spread:
            used = used.copy()
            used[worst] = False
            continue
        full = next(terms for least, terms in TERMS if np.count_nonzero(used) >= least)
        if count == full:
            break
    return np.asarray(coefficients), used


def _terms(at: Array) -> Array:
    x, y = at[:, 0], at[:, 1]
    ones = np.ones_like(x)
    return np.stack([ones, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=-1)
