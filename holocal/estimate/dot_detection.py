"""Dots of either sign and unknown size in a grey picture: where, how sure, and which look like their neighbours.

The size comes from `dot_scale`, the centres from `dot_fit`, in two rounds: what the first finds round a dot is what the
second expects of it, so that perspective and blur may change over the picture while a stain stays a stain.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from holocal.estimate.dot_fit import DiscFits, Shapes, fit_discs
from holocal.estimate.dot_scale import (
    AGREEING,
    DotScale,
    candidates,
    dot_scales,
    laplacian,
    lattice_agreement,
    local_rms,
    refined,
)

Array = NDArray[np.float64]
Single = NDArray[np.float32]

RADIUS_OF_SIGMA = 2**0.5  # a disc answers best to a Laplacian of Gaussian of radius / sqrt(2)
RADIUS_KEPT_PX = 4.5  # pixels are averaged down to about this radius: the time is bounded, no precision is lost
SHARE = 0.5  # of the local rms response: fainter maxima are no dots
SHARE_OF_ALL = 0.8  # of the rms of the strongest responses of several sizes
NEIGHBOURS = 24
FAR = 2.5  # deviations
SLOPE_RIDGE = 1.0  # dots' worth of belief that there is no slope
FIRST_EDGE = 8.0
FIRST_OPACITY = 0.8
WINDOW_OF_SPACING = 0.58  # a window ends before the next dot's edge
WINDOW_OF_RADIUS = 1.1
RIM = 6.0  # of an edge k the profile is down to 5 % at sqrt(1 + 6 / k) radii
WINDOW_MORE_PX = 2.0
SHRUNK = 1.25
WHOLE = 1.15  # radii, the blurred edge included, that must lie inside the picture
DOUBT = 2.0  # times what a sure dot may differ
LOOKED_AT = 150  # dots, before all are fitted
CLEAN = 0.15  # of the contrast: a larger misfit is no guide to sizes
FIRST_SIZES = (0.8, 1.1, 1.5)  # of the radius that the filter suggests
LOOK_ITERATIONS = 7
SIZE_UNLIKE = 0.15  # of log radius against the neighbours': the two iterations of most dots do not reach it
MISFIT_UNLIKE = 0.5  # of log misfit
UNFINISHED = 1.0  # sigmas that one more iteration would move the centre
SIZES_DIFFER = 1.5  # largest over smallest radius: above, dots of other sizes may have been missed
SIZE_STEP = 1.6
MOST_SIZES = 3  # steps to either side
SMALLEST_SIGMA_PX = 1.0
APART = 1.2  # sigmas between two dots
LEAST = 9  # dots


@dataclass(frozen=True)
class Dots:
    """Dots of a picture.

    `centre_px` (n, 2) as (x, y), (0, 0) the centre of the top left pixel; `sigma_px` (n,) of each coordinate;
    `radius_px` (n,); `contrast` (n,): a dark dot's step over its ground, a bright one's in the picture's unit;
    `spacing_px` (n,) the distance of neighbours thereabouts; `doubtful` (n,): not quite like their neighbours, as where
    the light ends; `dark`: darker than the ground.
    """

    centre_px: Array
    sigma_px: Array
    radius_px: Array
    contrast: Array
    spacing_px: Array
    doubtful: NDArray[np.bool_]
    dark: bool

    def __len__(self) -> int:
        return len(self.centre_px)


def find_dots(image: Single) -> Dots:
    """Return the dots of a grey picture (height, width), linear in light; none where nothing forms a lattice.

    Dots that the picture's edge cuts off, and spots unlike those around them in size, form or contrast, are left out.
    """
    picture = np.ascontiguousarray(image, np.float32)
    with ThreadPoolExecutor(2) as pool:  # one for dark dots, one for bright ones
        looks = list(pool.map(lambda scale: _look(picture, scale), dot_scales(picture)))
    seen = [look for look in looks if look is not None]
    if not seen:
        return _none(dark=True)
    best = min(seen, key=lambda look: look.misfit)  # gaps between fat dots form a lattice too, but are no discs
    factor = best.factor
    found = _of_starts(_binned(picture, factor), best.starts, best.dark)
    return Dots(
        centre_px=(found.centre_px + 0.5) * factor - 0.5,
        sigma_px=found.sigma_px * factor,
        radius_px=found.radius_px * factor,
        contrast=found.contrast,
        spacing_px=found.spacing_px * factor,
        doubtful=found.doubtful,
        dark=found.dark,
    )


@dataclass(frozen=True)
class _Starts:
    """Where dots may be: `place` (n, 2), `radius`, `spacing` (n,) thereabouts, `good` (n,): amid a lattice.

    `sigma` (n,) of the filter that answered best; `edge` of all.
    """

    place: Array
    radius: Array
    spacing: Array
    good: NDArray[np.bool_]
    sigma: Array
    edge: float = FIRST_EDGE

    def some(self, most: int) -> _Starts:
        """Return at most so many of the good ones."""
        good = np.flatnonzero(self.good)
        chosen = good[:: max(1, len(good) // most)]
        return _Starts(
            self.place[chosen], self.radius[chosen], self.spacing[chosen], self.good[chosen], self.sigma[chosen]
        )


@dataclass(frozen=True)
class _Look:
    """A first look at dots of one sign: where they may be in the picture binned by `factor`; how ill discs fit them."""

    starts: _Starts
    factor: int
    dark: bool
    misfit: float


def _look(picture: Single, scale: DotScale) -> _Look | None:
    """Return a look at a few dots of a scale, and the places of all, of several sizes where the few differ in size."""
    factor = max(1, int(RADIUS_OF_SIGMA * scale.sigma_px / RADIUS_KEPT_PX))
    image, sigma = _binned(picture, factor), scale.sigma_px / factor
    starts = _starts(image, (sigma,), scale.dark)
    if starts is None:
        return None
    few = starts.some(LOOKED_AT)
    opacity = FIRST_OPACITY if scale.dark else 0.0
    misfit, fits = np.inf, None
    for size in FIRST_SIZES:  # from too small a disc a fat dot's rim looks like a stain
        tried = replace(few, radius=np.minimum(few.radius * size, 0.45 * few.spacing))
        fitted = _fitted(image, few.place, _first_shapes(tried), few.spacing, opacity, iterations=LOOK_ITERATIONS)
        left = float(np.median(fitted.misfit))
        if left < misfit:
            misfit, fits = left, fitted
    if fits is None:
        return None
    if misfit > CLEAN:  # speckle: a free fit takes a grain for the spot
        return _Look(starts, factor, scale.dark, misfit)
    small, large = np.quantile(fits.shapes.radius_px, [0.05, 0.95])
    if large > SIZES_DIFFER * small:
        starts = _of_sizes(image, sigma, scale.dark) or starts
    larger = float(np.median(fits.shapes.radius_px / few.radius))
    radius = np.minimum(starts.radius * larger, 0.45 * starts.spacing)
    starts = replace(starts, radius=radius, edge=float(np.median(fits.shapes.edge)))
    return _Look(starts, factor, scale.dark, misfit)


def _of_sizes(image: Single, sigma: float, dark: bool) -> _Starts | None:
    """Return places of dots of all sizes: smaller and larger ones are added as long as there are any."""
    smaller = larger = 1  # steps
    starts = None
    for _ in range(MOST_SIZES):
        sigmas = tuple(sigma * SIZE_STEP**k for k in range(-smaller, larger + 1))
        starts = _starts(image, sigmas, dark)
        if starts is None:
            return None
        count = [np.count_nonzero(starts.good & (starts.sigma == size)) for size in (sigmas[0], sigmas[-1])]
        down, up = count[0] >= AGREEING and sigmas[0] > SMALLEST_SIGMA_PX, count[1] >= AGREEING
        if not down and not up:
            break
        smaller, larger = smaller + int(down), larger + int(up)
    return starts


def _starts(image: Single, sigmas: tuple[float, ...], dark: bool) -> _Starts | None:
    """Return the extrema of Laplacians of one or several sizes, of each group of close ones the strongest."""
    found = []
    responses = [laplacian(image, sigma, dark=dark) for sigma in sigmas]
    # Between large dots small maxima are noise: a dot of any size answers as strongly as its neighbours do.
    local = local_rms(np.maximum.reduce(responses), max(sigmas)) if len(sigmas) > 1 else None
    for sigma, response in zip(sigmas, responses, strict=True):
        at, strength = candidates(response, sigma, share=SHARE)
        if local is not None:
            strong = strength > SHARE_OF_ALL * local[at[:, 1], at[:, 0]]
            at, strength = at[strong], strength[strong]
        found.append((refined(response, at), strength, np.full(len(at), sigma)))
    place, strength, size = (np.concatenate(column) for column in zip(*found, strict=True))
    if len(sigmas) > 1:
        kept = np.ones(len(place), bool)
        pairs = cKDTree(place).query_pairs(APART * max(sigmas), output_type="ndarray")
        near = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1) < APART * size[pairs].max(axis=1)
        first, second = pairs[near].T
        kept[np.where(strength[first] < strength[second], first, second)] = False
        place, size = place[kept], size[kept]
    if len(place) < LEAST + 1:
        return None
    agreeing, first_step, second_step = lattice_agreement(place, np.arange(len(place)))
    good = agreeing >= AGREEING
    if np.count_nonzero(good) < AGREEING:
        return None
    nearest = np.minimum(np.linalg.norm(first_step, axis=1), np.linalg.norm(second_step, axis=1))
    spacing = _of_neighbours(place, nearest[:, None], good)[0][:, 0]
    return _Starts(place, np.minimum(RADIUS_OF_SIGMA * size, 0.45 * spacing), spacing, good, size)


def _first_shapes(starts: _Starts) -> Shapes:
    count = len(starts.place)
    return Shapes(starts.radius, np.zeros((count, 2)), np.full(count, starts.edge))


def _fitted(
    image: Single,
    place: Array,
    shapes: Shapes,
    spacing: Array,
    opacity: float,
    *,
    iterations: int = 2,
    rough: bool = False,
) -> DiscFits:
    widest = np.maximum(WINDOW_OF_SPACING * spacing, 2.5)
    rim = np.sqrt(1 + RIM / shapes.edge)
    window = np.minimum(WINDOW_OF_RADIUS * rim * shapes.radius_px + WINDOW_MORE_PX, widest)
    return fit_discs(image, place, shapes=shapes, window_px=window, opacity=opacity, iterations=iterations, rough=rough)


def _of_starts(image: Single, starts: _Starts, dark: bool) -> Dots:
    """Return the dots of a binned picture, in its pixels."""
    start, spacing, good, shapes = starts.place, starts.spacing, starts.good.copy(), _first_shapes(starts)
    opacity = FIRST_OPACITY if dark else 0.0
    place = start
    for rough in (True, False):
        fits = _fitted(image, place, shapes, spacing, opacity, rough=rough)
        looks = _looks(fits, dark)
        near = np.linalg.norm(fits.centre_px - start, axis=1) < 0.5 * shapes.radius_px
        place = np.where(near[:, None], fits.centre_px, start)
        good &= near
        if np.count_nonzero(good) < AGREEING:
            return _none(dark=dark)
        usual, spread = _of_neighbours(start, looks, good)
        if dark:  # where there is least haze the contrast shows it
            opacity = float(np.clip(np.quantile(np.exp(looks[good, 4]), 0.95), 0, 1))
        shapes = Shapes(np.exp(usual[:, 0]), usual[:, 1:3], np.exp(usual[:, 3]))
    fits = _refitted(image, fits, looks, usual, spacing, opacity)
    looks = _looks(fits, dark)
    kept = _alike(fits, looks, usual, spread, dark, factor=DOUBT)
    kept &= np.linalg.norm(fits.centre_px - start, axis=1) < 0.6 * np.maximum(shapes.radius_px, fits.shapes.radius_px)
    kept &= _whole(fits, shapes.radius_px, image.shape) & _single(fits)
    contrast = fits.amplitude / fits.ground if dark else fits.amplitude
    return Dots(
        fits.centre_px[kept],
        np.sqrt(fits.variance_px2[kept]),
        fits.shapes.radius_px[kept],
        np.abs(contrast[kept]),
        spacing[kept],
        ~_alike(fits, looks, usual, spread, dark)[kept],
        dark,
    )


def _refitted(image: Single, fits: DiscFits, looks: Array, usual: Array, spacing: Array, opacity: float) -> DiscFits:
    """Return the fits after more iterations for those that need them: dots that are larger or smaller than others."""
    unlike = (np.abs(looks[:, 0] - usual[:, 0]) > SIZE_UNLIKE) | (looks[:, 5] > usual[:, 5] + MISFIT_UNLIKE)
    chosen = np.flatnonzero(unlike | (fits.further_px > UNFINISHED * np.sqrt(fits.variance_px2)))
    if not len(chosen):
        return fits
    shapes = fits.shapes.some(chosen)
    more = _fitted(image, fits.centre_px[chosen], shapes, spacing[chosen], opacity, iterations=LOOK_ITERATIONS)
    return fits.bettered(chosen, more)


def _looks(fits: DiscFits, dark: bool) -> Array:
    """Return what neighbours are compared by, (n, 6): log radius, ellipticities, log edge, log contrast, residual."""
    contrast = np.abs(fits.amplitude) / (np.maximum(np.abs(fits.ground), 1e-12) if dark else 1.0)
    log_contrast = np.log(np.maximum(contrast, 1e-12))
    left = np.log(np.maximum(fits.misfit, 1e-12))
    shapes = fits.shapes
    return np.column_stack([np.log(shapes.radius_px), shapes.ellipticity, np.log(shapes.edge), log_contrast, left])


def _of_neighbours(places: Array, values: Array, good: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return what each place's nearest good dots say of it (n, values), and their robust deviation.

    A plane through them, since at the rim of a barrel or a tilted target all of them lie to one side; what is far from
    their median counts as if it were near.
    """
    count = min(NEIGHBOURS, int(np.count_nonzero(good)))
    distance, index = cKDTree(places[good]).query(places, k=np.arange(1, count + 1))
    near = values[good][index]
    middle = np.median(near, axis=1, keepdims=True)
    spread = 1.4826 * np.median(np.abs(near - middle), axis=1, keepdims=True)
    held = np.clip(near - middle, -FAR * spread, FAR * spread)
    offset = (places[good][index] - places[:, None]) / np.maximum(distance.mean(axis=1), 1e-12)[:, None, None]
    features = np.concatenate([np.ones((*index.shape, 1)), offset], axis=2)
    across = features.transpose(0, 2, 1)
    solved = np.linalg.solve(across @ features + np.diag([0, SLOPE_RIDGE, SLOPE_RIDGE]), across @ held)
    return middle[:, 0] + solved[:, 0], spread[:, 0]  # slope included: where there is one, a plane is a rough guide


def _alike(
    fits: DiscFits, looks: Array, usual: Array, spread: Array, dark: bool, factor: float = 1.0
) -> NDArray[np.bool_]:
    """Return which dots look like their neighbours: limits are wide where the neighbours differ, as speckle does."""
    least = np.array([0.35, 0.2, 0.2, 1.5, 1.0, 1.2])
    off = np.abs(looks - usual) <= factor * np.maximum(least, 5 * spread)
    off[:, 5] |= looks[:, 5] < usual[:, 5]  # a dot that fits better than others is welcome
    off[:, 5] |= looks[:, 5] < np.log(0.05)
    signed = (fits.amplitude < 0) if dark else (fits.amplitude > 0)
    return np.asarray(off.all(axis=1) & signed & (np.sqrt(fits.variance_px2) < 0.2 * fits.shapes.radius_px))


def _whole(fits: DiscFits, usual_px: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which dots the picture's edge does not cut off."""
    radius = fits.shapes.radius_px  # of a dot that is cut off it may be too small
    reach = WHOLE * np.clip(usual_px, radius, SHRUNK * radius)[:, None]
    limit = np.array([shape[1], shape[0]]) - 0.5
    return np.asarray(((fits.centre_px - reach > -0.5) & (fits.centre_px + reach < limit)).all(axis=1))


def _single(fits: DiscFits) -> NDArray[np.bool_]:
    """Return one of each group of fits that came to the same place: the surest."""
    kept = np.ones(len(fits.centre_px), bool)
    for i, j in cKDTree(fits.centre_px).query_pairs(float(np.median(fits.shapes.radius_px))):
        kept[i if fits.variance_px2[i] > fits.variance_px2[j] else j] = False
    return kept


def _binned(image: Single, factor: int) -> Single:
    if factor == 1:
        return image
    height, width = (factor * (n // factor) for n in image.shape)
    size = (width // factor, height // factor)
    return np.asarray(cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA), np.float32)


def _none(*, dark: bool) -> Dots:
    nothing = np.zeros(0)
    return Dots(np.zeros((0, 2)), nothing, nothing, nothing, nothing, np.zeros(0, bool), dark)
