"""A pattern of spots recognised in a picture: which way round the camera sees it, and that it is not seen a pitch off.

The spots lie irregularly (`procedures` draw each off its lattice), so that one shift and one orientation alone bring
picture and pattern together. How much better than all others it does is the margin; below it nothing is believed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from holocal.errors import RefusedError
from holocal.optics.bench import Array

FURTHEST = 0.3  # of the picture's size that it may be shifted
MARGIN = 1.1  # by which the best place must beat every other
BINNED = 2  # pixels each way taken together: the places are refined afterwards
ORIENTATIONS = (
    "upright", "turned by 90 degrees", "turned by 180 degrees", "turned by 270 degrees",
    "mirrored left to right", "mirrored and turned by 90 degrees", "mirrored top to bottom",
    "mirrored and turned by 270 degrees",
)  # fmt: skip


@dataclass(frozen=True)
class Recognised:
    """`shift_px` (column, row) of the pattern, its correlation coefficient `match`, and `rival`: the best of all other
    places, at least `apart_px` away, and orientations; `orientation` is the best one's name."""

    shift_px: Array
    match: float
    rival: float
    orientation: str


def recognise(picture: Array, places: Array, light: Array, *, sigma_px: float, apart_px: float) -> Recognised:
    """Return how a pattern of spots lies in a picture.

    Parameters
    ----------
    picture
        (height, width), dark level subtracted.
    places, light
        (n, 2) column and row, and (n,) light, of the spots as expected.
    sigma_px
        Radius of a spot, and of what a bench out of line moves single spots by.
    apart_px
        Two places of the pattern that are nearer are one.
    """
    height, width = picture.shape
    pattern = np.zeros((height, width))
    for (column, row), much in zip(places, light, strict=True):
        c, r = round(float(column)), round(float(row))
        if 0 <= c < width and 0 <= r < height and much > 0:
            pattern[r, c] += np.sqrt(much)
    pattern = _binned(gaussian_filter(pattern, 1.5 * sigma_px))
    smooth = _binned(np.sqrt(np.maximum(gaussian_filter(picture, sigma_px), 0.0)))
    found = []
    for number in range(8):
        turned = np.rot90(smooth if number < 4 else smooth[:, ::-1], number % 4)
        if turned.shape == pattern.shape:  # of a picture that is not square only half of them fit
            found.append((number, *_correlation(turned, pattern)))
    best = max(found, key=lambda one: float(one[1].max()))
    number, near, offsets = best
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    peak = float(near.max())
    rival = max((float(one[1].max()) for one in found if one[0] != number), default=0.0)
    down, across = offsets[0][:, None] - offsets[0][row], offsets[1][None] - offsets[1][column]
    elsewhere = np.hypot(down, across) >= apart_px / BINNED
    rival = max(rival, float(np.max(near, where=elsewhere, initial=-1.0)))
    shift = BINNED * np.array([offsets[1][column], offsets[0][row]], np.float64)
    return Recognised(shift, peak, rival, ORIENTATIONS[number])


def require_recognised(found: Recognised) -> Recognised:
    """Return a pattern that is seen upright, and nowhere else nearly as well.

    Raises
    ------
    RefusedError
        The camera's picture is mirrored or turned, or does not show the pattern.
    """
    sure = found.match >= MARGIN * max(found.rival, 0.0) and found.match > 0
    if sure and found.orientation == ORIENTATIONS[0]:
        return found
    seen = f"it matches best {found.orientation}, by {found.match:.2f}, the next best by {found.rival:.2f}"
    raise RefusedError(
        f"The camera's picture does not show the pattern as it was sent: {seen}; needed: upright, {MARGIN} times "
        "better.",
        why="A map from spots that are taken for others would bend the picture, not straighten it.",
        fix="Mount the camera upright and not mirrored (or set it so in its driver), and see that its field is the one "
        "of the rig's file.",
        measured={"match": found.match, "rival": found.rival, "orientation": found.orientation},
        limit={"margin": MARGIN, "orientation": ORIENTATIONS[0]},
        code="not-registered",
    )


def _binned(picture: Array) -> Array:
    height, width = (n // BINNED * BINNED for n in picture.shape)
    cut = picture[:height, :width]
    return np.asarray(cut.reshape(height // BINNED, BINNED, width // BINNED, BINNED).mean(axis=(1, 3)))


def _correlation(picture: Array, pattern: Array) -> tuple[Array, list[NDArray[np.int64]]]:
    """Return correlation coefficients of all shifts within reach, and the shifts along rows and columns."""
    shape = [next_fast_len(2 * n) for n in picture.shape]
    one, other = picture - picture.mean(), pattern - pattern.mean()
    values = irfft2(rfft2(one, shape) * np.conj(rfft2(other, shape)), shape)
    values = values / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-300)
    reach = [int(FURTHEST * n) for n in picture.shape]
    offsets = [np.r_[0 : r + 1, -r:0] for r in reach]
    return np.asarray(values[np.ix_(*offsets)]), offsets
