"""How large the dots of a picture are, how far apart, and whether they are dark: what forms a lattice decides.

Every size and both signs are tried: extrema of a Laplacian of Gaussian are candidates, and a candidate counts when its
neighbours lie as those of a lattice do. Dust, text, noise and the picture's edges do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Single = NDArray[np.float32]

SEARCHED_PIXELS = 1_500_000  # sizes are searched in a picture scaled to so many
SIGMAS_PX = (1.1, 1.6, 2.2)  # 1.1 of the first octave only: of the others it is the last of the one before
SMALLEST_SIDE = 40  # pixels: below, no octave more
MOST_CANDIDATES = 40_000
SAMPLED = 1_000  # candidates whose neighbours are looked at
OFF_LATTICE = 0.2  # of the spacing: how far a neighbour may lie from where a lattice has it
NEIGHBOURS = 9
AGREEING = 4  # of six neighbours
RIVAL = 0.3  # of the best scale's goodness: the other sign is then looked at too
FAINTEST = 0.02  # of the brightest responses: fainter maxima are left


@dataclass(frozen=True)
class DotScale:
    """What the dots of a picture are like.

    `sigma_px` of the Laplacian of Gaussian that answers best (a disc's radius is 1.41 of it), `spacing_px` the median
    distance of neighbours, `dark` dots on a brighter ground, `agreeing` how many of the `candidates` have neighbours as
    in a lattice, `strength` their median response in the picture's unit.
    """

    sigma_px: float
    spacing_px: float
    dark: bool
    agreeing: int
    candidates: int
    strength: float


def dot_scales(image: Single) -> list[DotScale]:
    """Return the scale of the dots in a grey picture (height, width): none where nothing forms a lattice.

    Two, one dark and one bright, where both form as good a lattice: fat dots and the gaps between them do.
    """
    shrink = max(1.0, float(np.sqrt(image.size / SEARCHED_PIXELS)))
    found = _searched(image, shrink) if shrink == 1 else _searched(_shrunk(image, shrink), shrink)
    if shrink > 1 and (not found or max(found, key=_goodness).sigma_px < SIGMAS_PX[1] * shrink):
        found += _of_level(image, 1.0, SIGMAS_PX)  # dots that the smaller picture is too coarse for
    found = [scale for scale in found if scale.agreeing >= AGREEING]
    of_sign = [[scale for scale in found if scale.dark == dark] for dark in (True, False)]
    best = [max(scales, key=_goodness) for scales in of_sign if scales]
    most = max((_goodness(scale) for scale in best), default=0.0)
    return [scale for scale in best if _goodness(scale) >= RIVAL * most]


def candidates(response: Single, sigma_px: float, *, share: float) -> tuple[NDArray[np.int64], Single]:
    """Return the local maxima of a response.

    Parameters
    ----------
    response
        (height, width), positive on the dots that are sought.
    sigma_px
        Of the filter: no two maxima are closer than 1.2 of it.
    share
        Of the local rms response that a maximum must reach, so that a dark corner's dots are found too.

    Returns
    -------
    places
        (n, 2), (x, y) in whole pixels.
    strength
        (n,), the response there.
    """
    reach = int(np.ceil(1.2 * sigma_px))
    highest = cv2.dilate(response, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    local = local_rms(response, sigma_px)
    brightest = float(np.quantile(response[:: 1 + reach // 2, :: 1 + reach // 2], 0.995))
    rows, columns = np.nonzero((response >= highest) & (response > np.maximum(share * local, FAINTEST * brightest)))
    strength = response[rows, columns]
    order = np.argsort(strength)[::-1][:MOST_CANDIDATES]
    return np.stack([columns, rows], axis=1)[order].astype(np.int64), strength[order]


def local_rms(response: Single, sigma_px: float) -> Single:
    """Return the rms of a filter's response in windows of 16 of its sigmas."""
    side = int(16 * sigma_px) | 1
    return np.asarray(np.sqrt(np.maximum(cv2.blur(response * response, (side, side)), 0)), np.float32)


def laplacian(image: Single, sigma_px: float, *, dark: bool) -> Single:
    """Return the Laplacian of Gaussian of a picture, times sigma squared, positive on dots of that sign."""
    smooth = cv2.GaussianBlur(image, (0, 0), sigma_px)
    second = cv2.Laplacian(smooth, cv2.CV_32F, ksize=1, scale=sigma_px**2)
    return np.asarray(second if dark else -second, np.float32)


def refined(response: Single, places: NDArray[np.int64]) -> Array:
    """Return the maxima (n, 2) of parabolas through each place and its neighbours along x and y."""
    padded = np.pad(response, 1, mode="edge")
    x, y = places[:, 0] + 1, places[:, 1] + 1
    moved = []
    for dx, dy in ((1, 0), (0, 1)):
        before, here, after = (padded[y + k * dy, x + k * dx].astype(np.float64) for k in (-1, 0, 1))
        curvature = np.minimum(before - 2 * here + after, -1e-12)
        moved.append(np.clip((before - after) / (2 * curvature), -0.5, 0.5))
    return np.asarray(places + np.stack(moved, axis=1))


def lattice_agreement(places: Array, sampled: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array, Array]:
    """Return how well the neighbours of places agree with a lattice round each.

    Parameters
    ----------
    places
        (n, 2) candidates, at least 9.
    sampled
        (m,) indices of those that are asked about.

    Returns
    -------
    agreeing
        (m,) how many of the six neighbours -a, -b, a + b, -a - b, a - b, b - a are there.
    first, second
        (m, 2) the steps a and b to the two nearest neighbours in different directions.
    """
    tree = cKDTree(places)
    here = places[sampled]
    _, index = tree.query(here, k=NEIGHBOURS)
    step = places[index[:, 1:]] - here[:, None]
    length = np.linalg.norm(step, axis=2)
    first = step[:, 0]
    across = np.abs(first[:, None, 0] * step[..., 1] - first[:, None, 1] * step[..., 0])
    across /= np.maximum(length * length[:, :1], 1e-12)
    chosen = np.argmax(across > 0.6, axis=1)  # the nearest that is 37 to 143 degrees off the first
    second = step[np.arange(len(step)), chosen]
    good = across[np.arange(len(step)), chosen] > 0.6
    spacing = np.minimum(np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1))
    agreeing = np.zeros(len(here), np.int64)
    for i, j in ((-1, 0), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        distance, _ = tree.query(here + i * first + j * second)
        agreeing += good & (distance < OFF_LATTICE * spacing)
    return agreeing, first, second


def _searched(level: Single, pixel: float) -> list[DotScale]:
    found: list[DotScale] = []
    while min(level.shape) >= SMALLEST_SIDE:
        found += _of_level(level, pixel, SIGMAS_PX[0 if pixel == 1 else 1 :])
        level, pixel = _shrunk(level, 2.0), 2 * pixel
    return found


def _shrunk(image: Single, factor: float) -> Single:
    size = (max(1, round(image.shape[1] / factor)), max(1, round(image.shape[0] / factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _of_level(level: Single, pixel: float, sigmas_px: tuple[float, ...]) -> list[DotScale]:
    """Return what forms a lattice at the sizes of one octave; `pixel` is the level's pixel in pixels of the picture."""
    found = []
    for sigma in sigmas_px:
        bright = laplacian(level, sigma, dark=False)
        for dark in (False, True):
            places, strength = candidates(-bright if dark else bright, sigma, share=0.8)
            if len(places) < 2 * NEIGHBOURS:
                continue
            sampled = np.unique(np.linspace(0, len(places) - 1, SAMPLED).astype(np.int64))
            agreeing, first, second = lattice_agreement(refined(-bright if dark else bright, places), sampled)
            good = agreeing >= AGREEING
            if np.count_nonzero(good) == 0:
                continue
            spacing = (np.linalg.norm(first[good], axis=1) + np.linalg.norm(second[good], axis=1)) / 2
            found.append(
                DotScale(
                    sigma_px=sigma * pixel,
                    spacing_px=float(np.median(spacing)) * pixel,
                    dark=dark,
                    agreeing=int(np.count_nonzero(good)) * len(places) // len(sampled),
                    candidates=len(places),
                    strength=float(np.median(strength[sampled][good])),
                )
            )
    return found


def _goodness(scale: DotScale) -> float:
    """Return what the best scale has most of: light that lies as in a lattice, among candidates that do."""
    return scale.strength * scale.agreeing**2 / scale.candidates
