"""The exposure of a speckled picture: its tail must not clip."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from holocal.estimate.blocks import block_means
from holocal.loop.devices import Frame
from procedures._exposure import next_guess

if TYPE_CHECKING:
    from procedures.uniformity import State

EXPOSURE_SHOTS = 6  # at most, to find the exposure
NOISE_TERMS = 9.0  # full scale lies this many speckle contrasts above the brightest mean: 3e-5 of the pixels clip


def with_exposure(state: State, frame: Frame) -> State:
    """Return the state with the exposure that suits the speckle's tail, or with the next guess.

    Full scale at twice the mean would clip the speckle and bias the map by 7 %: the brightest block's mean is put at
    full scale / (1 + 9 contrasts).
    """
    camera = state.facts.camera
    offset = float(np.quantile(frame.counts, 0.01))  # the corners of the field are dark
    counts = frame.counts.astype(np.float64) - offset
    block = state.parameters.block_px
    brightest = float(np.quantile(block_means(counts, block).mean, 0.98))
    guess = next_guess(frame, camera, brightest=brightest, last=state.searched + 1 >= EXPOSURE_SHOTS)
    if guess is not None:
        return replace(state, guess_s=guess, searched=state.searched + 1)
    lit = block_means(counts, block).mean > 0.5 * brightest
    rows, columns = (np.linspace(0, n, m + 1).round().astype(int) for n, m in zip(counts.shape, lit.shape, strict=True))
    contrasts = [
        part.std() / part.mean()
        for i, j in np.argwhere(lit)
        if (part := counts[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]).mean() > 0
    ]
    contrast = float(np.median(contrasts)) if contrasts else 1.0
    wanted = frame.exposure_s * camera.full_scale / (1 + NOISE_TERMS * contrast) / max(brightest, 1.0)
    if 0.2 * wanted <= frame.exposure_s <= 1.2 * wanted:  # speckle, not the sensor, is the noise: good enough to keep
        first = frame.counts.astype(np.float32) / np.float32(frame.exposure_s)
        return replace(state, exposure_s=frame.exposure_s, first=first)
    return replace(state, exposure_s=float(np.clip(wanted, camera.exposure_min_s, camera.exposure_max_s)))
