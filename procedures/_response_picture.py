"""The sign of a response: which of two holograms, made with the table and with its negative, gives the picture.

A fringe is the same for D and -D. A hologram is not: with the wrong sign the panel shows its complex conjugate, whose
light is as far out of focus as the bench has curvature.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from holocal.estimate.registration import SIGMA_SHARE, blob_image

FARTHEST = 0.15  # of the picture's width: a bench out of line by 2 degrees
TELLING = 0.08  # likenesses that differ by less say nothing: two pictures of speckle alone differ by 0.02


def likeness(picture: NDArray[np.floating[Any]]) -> float:
    """Return the correlation (-1 to 1) of a picture with the image of blobs, at the shift that fits best.

    Both are blurred as wide as a blob, and the root is taken: the brightest do not decide alone.
    """
    import cv2

    height, width = picture.shape
    sigma = SIGMA_SHARE * width

    def prepared(image: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        root = np.sqrt(np.maximum(smooth, 0.0)).astype(np.float64)
        return np.asarray(root - root.mean())

    seen, wanted = prepared(picture), prepared(blob_image(height, width))
    power = float(np.sqrt(np.sum(seen**2) * np.sum(wanted**2)))
    if power == 0.0:
        return 0.0
    shape = (next_fast_len(2 * height, real=True), next_fast_len(2 * width, real=True))
    together = irfft2(rfft2(seen, shape) * np.conj(rfft2(wanted, shape)), shape) / power
    reach = int(np.ceil(FARTHEST * width))
    near = together[np.ix_(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))]
    return float(near.max())


def picture_exposure_s(light_per_s: float, shape: tuple[int, int], full_scale: int) -> float:
    """Return the exposure that puts blobs at about a tenth of full scale, from the counts per second of a pattern.

    A hologram sends about as much of its light to the camera as a pattern of rows does, all of it to the blobs.
    """
    area = float(blob_image(*shape).sum())
    return 0.1 * full_scale * area / max(light_per_s, 1e-9)
