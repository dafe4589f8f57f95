"""How good a hologram looks: PSNR with its definition, and every encoder on one plain Fourier hologram.

The geometry: a panel of N x N pixels, its orthonormal Fourier transform the far field, the image of M x M pixels in the
middle of it, light outside it free. An image pixel is one far-field sample wide.

`encoder_table` measures; `as_text` writes it down: ``python -c "from holocal.hologram import quality as q;
import sys; sys.stdout.write(q.as_text(q.encoder_table(q.photographs())))"``
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
import torch
from numpy.typing import ArrayLike, NDArray

from holocal.errors import InputError
from holocal.hologram.encode.direct_search import DirectSearch
from holocal.hologram.encode.double_phase import DoublePhase
from holocal.hologram.encode.encoder import Encoder, Target
from holocal.hologram.encode.error_diffusion import ErrorDiffusion
from holocal.hologram.encode.far_field import FarField
from holocal.hologram.encode.fourier import WindowedTransform
from holocal.hologram.encode.goals import CameraGoal, ModulusGoal
from holocal.hologram.encode.gradient_descent import GradientDescent
from holocal.hologram.encode.ifta_encoder import Ifta
from holocal.optics.bench import Array

# Far-field samples per image pixel and axis that a camera's pixel averages, as peers' numbers have it. With 8 a camera
# image of 38.6 dB has 38.5, one of 53.0 dB 48.3: the highest numbers are as exact as the camera is known to be.
_FINE = 4


def psnr_db(seen: ArrayLike, wanted: ArrayLike, *, fitted: bool = True) -> float:
    """Return the peak signal-to-noise ratio of amplitudes in dB, for a peak of 1.

    Domain: amplitudes, the roots of intensities, as in neural-holography's eval.py. Scale: the factor on `seen` that
    fits `wanted` best in least squares, or the one that makes their energies equal (`fitted` False). Region: all
    that is given. Oversampling: none; see `camera_amplitude`.

    Examples
    --------
    >>> round(psnr_db([2.0, 0.0], [1.0, 0.0]))
    200
    >>> round(psnr_db([1.0, 1.0], [1.0, 0.0]), 2)  # the fitted scale is 1/2: 0.25 mean square
    6.02
    """
    found, asked = np.asarray(seen, np.float64), np.asarray(wanted, np.float64)
    if found.shape != asked.shape:
        raise InputError(f"A PSNR compares arrays of one shape; these are {found.shape} and {asked.shape}.")
    energy = max(float(np.sum(found**2)), 1e-300)
    scale = float(np.sum(found * asked)) / energy if fitted else (float(np.sum(asked**2)) / energy) ** 0.5
    return float(-10 * np.log10(max(float(np.mean((scale * found - asked) ** 2)), 1e-20)))


def grid_amplitude(field: torch.Tensor, image: tuple[int, int]) -> Array:
    """Return the far field's modulus on one sample in the middle of each image pixel: what lies between is not seen."""
    return np.asarray(FarField(field.shape[0], field.shape[1], image).forward(field).abs().numpy(), np.float64)


def camera_amplitude(field: torch.Tensor, image: tuple[int, int], *, shift_quarters: tuple[int, int] = (0, 0)) -> Array:
    """Return the root of the far field's intensity averaged over each image pixel, from 4 x 4 samples in each.

    `shift_quarters` (rows, columns) moves the camera's pixels by quarters of an image pixel down and right, 0 to 4; the
    last row or column, half outside the image, is left out then.
    """
    spectrum = FarField(field.shape[0], field.shape[1], image, finer=_FINE).forward(field)
    light = np.asarray(torch.view_as_real(spectrum).square().sum(dim=-1).numpy(), np.float64)
    for axis, quarters in enumerate(shift_quarters):
        kept = light.shape[axis] // _FINE - (quarters > 0)
        light = np.take(light, range(quarters, quarters + kept * _FINE), axis=axis)
    rows, columns = light.shape[0] // _FINE, light.shape[1] // _FINE
    return np.asarray(np.sqrt(light.reshape(rows, _FINE, columns, _FINE).sum(axis=(1, 3))))


@dataclass(frozen=True)
class Quality:
    """What is seen of a field: PSNR on the grid, by a camera, by a camera half a pixel off, and the image's light."""

    grid_db: float
    camera_db: float
    shifted_db: float
    efficiency: float


def quality(field: torch.Tensor, amplitude: Array) -> Quality:
    """Return the quality of a field whose far field should have an amplitude (rows, columns), peak 1.

    `efficiency` is the share of the panel's light in the image. The shifted camera's pixels lie half an image pixel
    down and right; it should see the mean intensity of the four image pixels that each covers.
    """
    shape = (amplitude.shape[0], amplitude.shape[1])
    seen = camera_amplitude(field, shape)
    light = amplitude**2
    four = np.sqrt((light[1:, 1:] + light[:-1, 1:] + light[1:, :-1] + light[:-1, :-1]) / 4)
    half = (_FINE // 2, _FINE // 2)
    return Quality(
        psnr_db(grid_amplitude(field, shape), amplitude),
        psnr_db(seen, amplitude),
        psnr_db(camera_amplitude(field, shape, shift_quarters=half), four),
        float(np.sum(seen**2)) / field.numel(),
    )


def random_phase(shape: tuple[int, int], pixels: int, *, seed: int = 0) -> Array:
    """Return a phase that is random from image pixel to image pixel: light everywhere on the panel, speckle."""
    return np.random.default_rng(seed).uniform(0, 2 * np.pi, shape)


def quadratic_phase(shape: tuple[int, int], pixels: int, *, fill: float = 0.9) -> Array:
    """Return a lens's phase that spreads the image over `fill` of a panel `pixels` wide: no speckle at the start."""
    y, x = (np.arange(size) - size // 2 for size in shape)
    return np.asarray(np.pi * fill * (y[:, None] ** 2 / shape[0] + x**2 / shape[1]), np.float64)


def grid_target(amplitude: Array, phase_rad: Array, pixels: int) -> Target:
    """Return the hologram of an image on a panel of pixels x pixels, asked for on one sample per image pixel."""
    rows, columns = amplitude.shape
    transform = WindowedTransform(pixels, pixels, rows // 2, columns // 2)
    places = [np.fft.fftfreq(2 * k + 1, 1 / (2 * k + 1)).astype(int) for k in (rows // 2, columns // 2)]
    inside = [line + size // 2 for line, size in zip(places, (rows, columns), strict=True)]
    window = (inside[0][:, None] < rows) & (inside[1] < columns)
    image = (amplitude * np.exp(1j * phase_rad)).astype(np.complex64)
    wanted = image[np.minimum(inside[0], rows - 1)[:, None], np.minimum(inside[1], columns - 1)] * window
    compact = torch.from_numpy(wanted.astype(np.complex64))
    return Target(transform.adjoint(compact), compact, torch.from_numpy(window), transform)


def fine_target(amplitude: Array, phase_rad: Array, pixels: int) -> Target:
    """Return the same hologram, asked for on a grid twice as fine, each image pixel's amplitude on its 2 x 2 samples.

    What it wants there has the phase of the full-complex hologram, so that between samples too it can be had.
    """
    shape = (amplitude.shape[0], amplitude.shape[1])
    image = torch.from_numpy((amplitude * np.exp(1j * phase_rad)).astype(np.complex64))
    start = FarField(pixels, pixels, shape).adjoint(image)
    transform = FarField(pixels, pixels, shape, finer=2, margin=1)
    asked = torch.from_numpy(np.pad(np.kron(amplitude / 2, np.ones((2, 2))), 1).astype(np.float32))
    wanted = torch.polar(asked, torch.angle(transform.forward(start)))
    window = torch.ones(wanted.shape, dtype=torch.bool)
    return Target(start, wanted, window, transform)


@dataclass(frozen=True)
class Row:
    """One line of the table: what was run, what it cost, what it gives."""

    image: str
    start: str
    grid: str
    method: str
    iterations: int
    pairs: float
    quality: Quality


def photographs(size: int = 512) -> dict[str, Array]:
    """Return amplitudes, peak 1, of two photographs: roots of skimage's camera and astronaut (grey)."""
    import skimage.color
    import skimage.data
    import skimage.transform

    pictures = {"camera": skimage.data.camera() / 255.0, "astronaut": skimage.color.rgb2gray(skimage.data.astronaut())}
    return {
        name: np.sqrt(np.clip(skimage.transform.resize(picture, (size, size)), 0, 1))
        for name, picture in pictures.items()
    }


def encoders(iterations: int) -> list[tuple[str, str, Encoder]]:
    """Return (grid, name, encoder) of everything worth comparing at a number of transform pairs."""
    passes = max(1, round(iterations / 4))  # four places on the lattice per pass
    return [
        ("1x", "Ifta", Ifta(iterations)),
        ("1x", "GradientDescent, field", GradientDescent(iterations)),
        ("1x", "DirectSearch", DirectSearch(passes, least_gain=0.0)),
        ("1x", "Gerchberg-Saxton, window", GradientDescent(iterations, ModulusGoal(), momentum=0.0)),
        ("2x", "Gerchberg-Saxton, window", GradientDescent(iterations, ModulusGoal(), momentum=0.0)),
        ("2x", "GradientDescent, field", GradientDescent(iterations)),
        ("2x", "GradientDescent, modulus", GradientDescent(iterations, ModulusGoal())),
        ("2x", "GradientDescent, camera", GradientDescent(iterations, CameraGoal())),
    ]


def one_pass() -> list[tuple[str, str, Encoder]]:
    """Return the encoders that have no iterations."""
    return [("1x", "ErrorDiffusion", ErrorDiffusion()), ("1x", "DoublePhase", DoublePhase())]


def encoder_table(images: Mapping[str, Array], *, pixels: int = 1024, counts: Sequence[int] = (10, 50)) -> list[Row]:
    """Return every encoder's quality and cost for each image, from a random and from a quadratic phase.

    Parameters
    ----------
    images
        Amplitudes, peak 1.
    pixels
        Of the panel along each axis.
    counts
        Iterations.
    """
    rows = []
    for name, amplitude in images.items():
        shape = (amplitude.shape[0], amplitude.shape[1])
        for start, phase in (("random", random_phase(shape, pixels)), ("quadratic", quadratic_phase(shape, pixels))):
            targets = {
                "1x": grid_target(amplitude, phase, pixels),
                "2x": fine_target(amplitude, phase, pixels),
            }
            cases = [(0, case) for case in one_pass()] + [(n, case) for n in counts for case in encoders(n)]
            for iterations, (grid, method, encoder) in cases:
                field, pairs = _timed(encoder, targets[grid])
                rows.append(Row(name, start, grid, method, iterations, pairs, quality(field, amplitude)))
    return rows


def _timed(encoder: Encoder, target: Target) -> tuple[torch.Tensor, float]:
    """Return an encoder's field and what it took, in pairs of transforms of the field timed before and after."""
    before = pair_seconds(target.start)
    begin = time.perf_counter()
    field = encoder(target).field
    spent = time.perf_counter() - begin
    return field, spent / float(np.median([*before, *pair_seconds(target.start)]))


def pair_seconds(field: torch.Tensor, repeats: int = 5) -> list[float]:
    """Return how long a bare complex64 FFT and its inverse take, two workers, each of some repeats."""
    data: NDArray[np.complex64] = field.numpy()
    spent = []
    for _ in range(repeats):
        begin = time.perf_counter()
        scipy.fft.ifft2(scipy.fft.fft2(data, workers=2), workers=2, overwrite_x=True)
        spent.append(time.perf_counter() - begin)
    return spent


def as_text(rows: Iterable[Row]) -> str:
    """Return a table as lines of text."""
    head = (
        f"{'image':10}{'start':11}{'grid':5}{'method':27}{'n':>3}{'pairs':>8}{'grid dB':>9}{'camera':>8}{'half off':>9}"
    )
    lines = [head + f"{'light':>7}"]
    for row in rows:
        seen = row.quality
        lines.append(
            f"{row.image:10}{row.start:11}{row.grid:5}{row.method:27}{row.iterations:3d}{row.pairs:8.1f}"
            f"{seen.grid_db:9.1f}{seen.camera_db:8.1f}{seen.shifted_db:9.1f}{seen.efficiency:7.2f}"
        )
    return "\n".join(lines) + "\n"
