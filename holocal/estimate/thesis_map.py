"""The thesis's estimate of the brightness (3.2, figure 3.4): block means, then a Gaussian low-pass."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

WINDOW_PX = 2300  # the picture is brought to this size
BLOCK_PX = 100  # squares of this side are replaced by their mean
SIGMA_PX = 100.0  # of the Gaussian, in pixels of the window


def thesis_map(picture: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the thesis's brightness map of a picture of a white square, (2300, 2300), in the picture's unit.

    The picture is upsampled (bilinearly) to 2300 x 2300, its 23 x 23 squares of 100 pixels are replaced by their means,
    and the result is low-pass filtered by a Gaussian of 100 pixels, the border repeated (the thesis does not say).

    A Gaussian of a picture that is constant over squares is a sum of differences of error functions, one per square and
    axis: this closed form takes 15 ms where filtering 2300 x 2300 pixels takes 2 s.
    """
    means = thesis_blocks(picture)
    along_y, along_x = (_smoothing(count) for count in means.shape)
    return np.asarray(along_y @ means @ along_x.T)


def thesis_blocks(picture: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the means of the 23 x 23 squares, (23, 23)."""
    large = cv2.resize(np.asarray(picture, np.float32), (WINDOW_PX, WINDOW_PX), interpolation=cv2.INTER_LINEAR)
    count = WINDOW_PX // BLOCK_PX
    return np.asarray(large.reshape(count, BLOCK_PX, count, BLOCK_PX).mean(axis=(1, 3), dtype=np.float64))


def at_size(brightness: NDArray[np.float64], height: int, width: int) -> NDArray[np.float64]:
    """Return a map brought to another size by area means, (height, width)."""
    return np.asarray(cv2.resize(brightness, (width, height), interpolation=cv2.INTER_AREA))


def _smoothing(count: int) -> NDArray[np.float64]:
    """Return the (pixels, squares) matrix of the Gaussian along one axis, the outermost squares going on for ever."""
    at = np.arange(count * BLOCK_PX) + 0.5
    edges = np.arange(1, count) * float(BLOCK_PX)
    below = np.asarray(0.5 * (1 + erf((edges - at[:, None]) / (np.sqrt(2) * SIGMA_PX))))
    below = np.concatenate([np.zeros((len(at), 1)), below, np.ones((len(at), 1))], axis=1)
    return np.asarray(np.diff(below, axis=1))
