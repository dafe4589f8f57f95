"""What a camera window shows of a spot: pupil field, pupil's rim, wavefront and amplitude to counts, with derivatives.

The field that a *known* frame sends towards a zone is known: sum u exp(-i phi_p) over the panel's blocks
(`holocal.optics.spots.analyse`), light meant for other zones and the quantisation's noise included. Unknown is what
the bench adds to it. With U(q) that field over the points q at which the zone's own direction crosses the pupil,

    E(ds) = sum_q T(q - q0) F [U exp(a + i W)](q) exp(i k q . ds),        I = integral of |E|^2 over a pixel

W the wavefront (a delay, radians) and a the logarithm of the amplitude, both belonging to the panel's points; F the way
from the panel's image to the pupil r in front of it (a phase k r ds^2 / 2 on the directions); T the pupil's
transmission, q0 where it lies. (W and a put in the pupil's plane instead leave 0.1 rad of defocus at 4K: the beam's own
fall-off is mistaken for it. F left out, the pupil's rim leaves 0.03 rad.)

W and a are Legendre products over the box that the zone's light fills, along the camera's pixel axes: all
transforms are separable, matrix products, and one set of them serves the derivatives by W and by a.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeVar

import finufft
import numpy as np
import torch
from numpy.polynomial import legendre
from numpy.typing import NDArray

from holocal.optics.bench import Array

NUFFT_EPS = 1e-4
MARGIN_PX = 6  # the field is computed over so much more than the window: what W throws into it comes from there
LEAST_HELD = 0.5  # of the light beside a zone's direction: less is not made up for
SPARE = 1.1  # of the period that the pupil's plane gets by sampled directions, over its box
# The mean over a pixel is a weighted sum of samples in it and of some beside it; by few samples, and so exactly.
BESIDE, RULE_ERROR, MOST_SAMPLES = 2, 3e-3, 16

Value = TypeVar("Value", bound=np.generic)
Seen = tuple[Array, NDArray[np.complex64]]  # pupil points (n, 2), values (n,): what `analyse` gives for a zone


@dataclass(frozen=True)
class Window:
    """The pixels of a zone: (2 half + 1) columns and rows, the middle one at (column, row); where they look.

    `direction` (2, 2) takes an offset in pixels (columns to the right, rows *up*) to direction sines in P. To second
    order, the pixel at (x, y) from the middle shows what the model has at (x, y) + `curve` (2, 3) @ (x^2, x y, y^2).
    `envelope` (2,) is the logarithmic slope of the light per pixel that is not the pupil's: the panel's pixels send
    less light the farther they turn it. `relief_m` (2, 2) is d q / d s, how the pupil point of light from a place of
    the panel moves with the direction, at q = 0, and `relief_slope` (2, 2, 2) its derivative by q. `magnified` (2, 2)
    takes q to where the light of a bench out of line crosses the pupil, but for a shift. `block_m` (2, 2) is how far q
    moves with a block along each axis of the panel: `analyse` has less of the light beside the zone's own direction.
    """

    column: int
    row: int
    half: tuple[int, int]
    direction: Array
    relief_m: Array
    relief_slope: Array = field(default_factory=lambda: np.zeros((2, 2, 2)))
    curve: Array = field(default_factory=lambda: np.zeros((2, 3)))
    envelope: Array = field(default_factory=lambda: np.zeros(2))
    magnified: Array = field(default_factory=lambda: np.eye(2))
    block_m: Array = field(default_factory=lambda: np.zeros((2, 2)))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return 2 * self.half[1] + 1, 2 * self.half[0] + 1

    def cut(self, picture: NDArray[Value]) -> NDArray[Value]:
        """Return the window's pixels of a picture (height, width); 0 where it reaches beyond."""
        x, y = self.half
        rows, columns = np.arange(self.row - y, self.row + y + 1), np.arange(self.column - x, self.column + x + 1)
        within = [(at >= 0) & (at < size) for at, size in zip((rows, columns), picture.shape, strict=True)]
        out = np.zeros(self.shape, picture.dtype)
        out[np.ix_(*within)] = picture[np.ix_(rows[within[0]], columns[within[1]])]
        return out

    @property
    def pixel(self) -> float:
        """A pixel's size in direction sines, the root of its area."""
        return float(np.sqrt(abs(np.linalg.det(self.direction))))

    @property
    def mixed_relief_m(self) -> Array:
        """The part of `relief_m` that turns light along one axis of the pixels to the other, (2, 2) in P."""
        metric = self.direction.T @ self.relief_m @ self.direction
        back = np.linalg.inv(self.direction)
        return np.asarray(back.T @ (metric - np.diag(np.diag(metric))) @ back)

    @property
    def to_pupil(self) -> Array:
        """The matrix that takes points along the pixels' axes (n, 2) to pupil points: q = p @ to_pupil."""
        return np.asarray(np.linalg.inv(self.direction / self.pixel))


@dataclass(frozen=True)
class PupilBox:
    """The part of the pupil's plane that a zone's light fills: a box along the camera's pixel axes, metres.

    A point p of it is the pupil point q = p @ `to_pupil`.
    """

    centre_m: tuple[float, float]
    half_m: tuple[float, float]
    to_pupil: Array

    @classmethod
    def around(cls, pupil_m: Array, window: Window, margin_m: float) -> PupilBox:
        """Return the box round pupil points (n, 2), wider by a margin."""
        turned = pupil_m @ np.linalg.inv(window.to_pupil)
        low, high = turned.min(axis=0) - margin_m, turned.max(axis=0) + margin_m
        middle, half = (low + high) / 2, (high - low) / 2
        return cls((float(middle[0]), float(middle[1])), (float(half[0]), float(half[1])), window.to_pupil)

    def legendre(self, pupil_m: Array, degree: int) -> Array:
        """Return the products P_i P_j, (n, terms), at pupil points (n, 2)."""
        turned = (pupil_m @ np.linalg.inv(self.to_pupil) - self.centre_m) / self.half_m
        in_x, in_y = (legendre.legvander(turned[:, axis], degree) for axis in (0, 1))
        return np.stack([in_x[:, i] * in_y[:, j] for i, j in products(degree)], axis=-1)


def products(degree: int) -> tuple[tuple[int, int], ...]:
    """Return (i, j) of the products P_i(x) P_j(y) of total degree up to `degree`; (0, 0) first, by degree.

    >>> products(1)
    ((0, 0), (1, 0), (0, 1))
    """
    return tuple((n - j, j) for n in range(degree + 1) for j in range(n + 1))


@dataclass(frozen=True)
class Pupil:
    """The pupil: its radius, the width of its soft rim (a raised cosine), metres; and the wavelength."""

    radius_m: float
    edge_m: float
    wavelength_m: float

    @property
    def wavenumber(self) -> float:
        """k, radians per metre."""
        return 2 * np.pi / self.wavelength_m


class SpotModel:
    """The picture of one zone in several frames of known levels.

    Parameters
    ----------
    window, box
        The zone's pixels, and what part of the pupil's plane may be lit.
    seen
        For each frame the pupil points (n, 2) and values (n,) of `analyse`.
    degree
        Of W and a.
    bends_per_m, bent_about_m
        For each frame the known defocus: its light turns by -bend (q - bent_about_m). Where the relief differs over
        the pupil, or has a mixed part, the rim that this light sees lies elsewhere: by 10 um at 4K, some percent of
        the light.
    """

    def __init__(
        self,
        window: Window,
        seen: Sequence[Seen],
        box: PupilBox,
        pupil: Pupil,
        *,
        degree: int,
        bends_per_m: Sequence[float] | None = None,
        bent_about_m: Array | None = None,
        device: str = "cpu",
    ) -> None:
        self.window, self.box, self.pupil, self.degree, self.device = window, box, pupil, degree, device
        per_metre = pupil.wavenumber * window.pixel  # radians per pixel
        coarse = [int(np.ceil(SPARE * 2 * half * per_metre / (2 * np.pi))) for half in box.half_m]
        wide = [_offsets(2 * (half + MARGIN_PX) + 1, f) for half, f in zip(window.half, coarse, strict=True)]
        rules = [pixel_rule(2 * min(half, pupil.radius_m) * per_metre / (2 * np.pi)) for half in box.half_m]
        fine = [len(rule) - 2 * BESIDE for rule in rules]
        near = [_offsets(2 * half + 1, f, more=BESIDE) for half, f in zip(window.half, fine, strict=True)]
        grid = []  # of the pupil's plane: a period of the field's transform over its own width
        for axis in (0, 1):
            step = 2 * np.pi / (len(wide[axis]) / coarse[axis]) / per_metre
            low, high = box.centre_m[axis] - box.half_m[axis], box.centre_m[axis] + box.half_m[axis]
            grid.append(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step)
        q = np.stack(np.meshgrid(grid[0], grid[1]), axis=-1) @ box.to_pupil
        bends = np.zeros(len(seen)) if bends_per_m is None else np.asarray(bends_per_m, np.float64)
        turn = -(q - (np.zeros(2) if bent_about_m is None else bent_about_m))
        relief = window.mixed_relief_m + np.einsum("ijk,yxk->yxij", window.relief_slope, q)
        moved = np.einsum("yxij,yxj->yxi", relief, turn)
        # (frames, rows, columns, 2), as the rim has it
        self.pupil_m = q @ window.magnified.T + bends[:, None, None, None] * moved
        self.field = self._complex(self._in_pupil(seen, wide, coarse, grid, per_metre))
        self._out_x = self._complex(np.exp(1j * per_metre * np.outer(grid[0], near[0])))
        self._out_y = self._complex(np.exp(1j * per_metre * np.outer(near[1], grid[1])))
        # The phase k ds r ds / 2 along each axis of the picture; its mixed part is the rim's (`pupil_m`).
        metric = window.direction.T @ window.relief_m @ window.direction * pupil.wavenumber / 2
        ways = [
            np.exp(-1j * per_metre * np.outer(g, w))
            * np.exp(1j * metric[a, a] * w * w)
            / len(w)
            @ np.exp(1j * per_metre * np.outer(w, g))
            for a, (g, w) in enumerate(zip(grid, wide, strict=True))
        ]
        self._way_x, self._way_y = self._complex(ways[0].T), self._complex(ways[1])
        in_x, in_y = (legendre.legvander((grid[a] - box.centre_m[a]) / box.half_m[a], degree) for a in (0, 1))
        self._in_x, self._in_y = (self._real(np.asarray(table.T, np.float64)) for table in (in_x, in_y))
        over_x, over_y = (_pixel_means(2 * half + 1, rule) for half, rule in zip(window.half, rules, strict=True))
        fall_x, fall_y = (
            np.exp(slope * np.arange(-half, half + 1.0))[:, None]
            for slope, half in zip(window.envelope, window.half, strict=True)
        )
        self._over_x = self._real((over_x * fall_x).T)
        self._over_y = self._real((over_y * fall_y)[::-1])  # row 0 is on top

    def only(self, frames: Sequence[int]) -> SpotModel:
        """Return the model of some of the frames."""
        chosen = copy.copy(self)
        chosen.field, chosen.pupil_m = self.field[list(frames)], self.pupil_m[list(frames)]
        return chosen

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return int(self.field.shape[0])

    def _in_pupil(
        self, seen: Sequence[Seen], wide: list[Array], coarse: list[int], grid: list[Array], per_metre: float
    ) -> NDArray[np.complex64]:
        """Return U on the grid of q, (frames, rows up, columns), by way of the directions near the zone's own."""
        # The transform's own samples have one at 0; an even number of ours has none.
        counts = [len(w) for w in wide]
        shift = [0.5 / f if n % 2 == 0 else 0.0 for f, n in zip(coarse, counts, strict=True)]
        ds = np.stack(np.meshgrid(wide[0], wide[1]), axis=-1) @ self.window.direction.T
        held = np.prod(np.sinc(ds @ self.window.block_m * self.pupil.wavenumber / (2 * np.pi)) ** 2, axis=-1)
        made_up = (1 / np.maximum(held, LEAST_HELD**2) / np.prod(counts)).astype(np.float32)
        back_x = np.exp(-1j * per_metre * np.outer(wide[0], grid[0])).astype(np.complex64)
        back_y = np.exp(-1j * per_metre * np.outer(grid[1], wide[1])).astype(np.complex64)
        turn = np.linalg.inv(self.box.to_pupil) * per_metre  # radians per pixel
        out = np.empty((len(seen), len(grid[1]), len(grid[0])), np.complex64)
        for frames in _of_one_pupil(seen):
            angle = seen[frames[0]][0] @ turn
            steps = [np.mod(angle[:, a] / coarse[a] + np.pi, 2 * np.pi) - np.pi for a in (0, 1)]
            source = np.stack([seen[frame][1] for frame in frames])
            if any(shift):
                source = source * np.exp(1j * (angle @ shift)).astype(np.complex64)
            there = finufft.nufft2d1(
                steps[1].astype(np.float32), steps[0].astype(np.float32), source, (counts[1], counts[0]),
                eps=NUFFT_EPS, isign=1, nthreads=1,
            )  # fmt: skip
            out[frames] = back_y @ (there * made_up) @ back_x
        return out

    def _real(self, values: Array) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(self.device)

    def _complex(self, values: NDArray[np.complexfloating[Any, Any]]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.complex64)).to(self.device)

    def transmission(self, shift_m: Array) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the pupil's transmission on the grid (frames, ...), and its derivatives (frames, 2, ...) per metre."""
        x, y = self._real(self.pupil_m[..., 0] - shift_m[0]), self._real(self.pupil_m[..., 1] - shift_m[1])
        edge_m = max(self.pupil.edge_m, 1e-5)
        r = torch.clamp(torch.hypot(x, y), min=1e-6)
        z = torch.clamp((self.pupil.radius_m - r) / edge_m, -0.5, 0.5)
        slope = torch.where(z.abs() < 0.5, 0.5 * np.pi / edge_m * torch.cos(np.pi * z), 0.0)
        return 0.5 + 0.5 * torch.sin(np.pi * z), torch.stack([slope * x / r, slope * y / r], dim=1)

    def intensity(self, wavefront_rad: Array, log_amplitude: Array, shift_m: Array) -> torch.Tensor:
        """Return the power on every pixel, (frames, rows, columns), row 0 on top.

        `wavefront_rad` and `log_amplitude` (terms,) are coefficients of `products(degree)`, `shift_m` (2,) is q0.
        """
        aperture, _ = self.transmission(shift_m)
        there = self._way_y @ (self._lit(wavefront_rad, log_amplitude) @ self._way_x)
        return self._pixels(self._to_window(there * aperture).abs() ** 2)

    def derivatives(
        self, wavefront_rad: Array, log_amplitude: Array, shift_m: Array, *, degree: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the intensity and its derivatives.

        Returns
        -------
        intensity, by_products, by_shift
            `by_products` (frames, 2, terms, rows, columns): by the wavefront's terms and the amplitude's, those up to
            `degree`; `by_shift` (frames, 2, rows, columns) per metre.
        """
        aperture, slope = self.transmission(shift_m)
        lit = self._lit(wavefront_rad, log_amplitude)
        across = [(lit * self._in_x[i]) @ self._way_x for i in range(degree + 1)]
        down = [self._way_y * self._in_y[j] for j in range(degree + 1)]
        bare = down[0] @ across[0]
        field = self._to_window(bare * aperture)
        pairs = []
        for i, j in products(degree):
            change = field.conj() * self._to_window((down[j] @ across[i]) * aperture)
            pairs.append(torch.stack([self._pixels(-2 * change.imag), self._pixels(2 * change.real)], dim=1))
        moved = self._to_window(bare[:, None] * slope)
        by_shift = self._pixels(2 * (field[:, None].conj() * moved).real)
        return self._pixels(field.abs() ** 2), torch.stack(pairs, dim=2), by_shift

    def _lit(self, wavefront_rad: Array, log_amplitude: Array) -> torch.Tensor:
        """Return U exp(a + i W) on the pupil's grid, (frames, ...)."""
        table = np.zeros((2, self.degree + 1, self.degree + 1))
        for k, (i, j) in enumerate(products(self.degree)):
            table[0, j, i], table[1, j, i] = wavefront_rad[k], log_amplitude[k]
        phase, log = (self._in_y.T @ self._real(one) @ self._in_x for one in table)
        return self.field * torch.polar(torch.exp(log), phase)

    def _to_window(self, pupil: torch.Tensor) -> torch.Tensor:
        return self._out_y @ (pupil @ self._out_x)

    def _pixels(self, fine: torch.Tensor) -> torch.Tensor:
        """Return the mean over each pixel, (..., rows, columns), row 0 on top, of samples with rows up."""
        return self._over_y @ (fine @ self._over_x)


def _offsets(pixels: int, fine: int, more: int = 0) -> Array:
    """Return sample places in pixels from the middle one's centre: `fine` in each pixel, `more` at both ends."""
    count = pixels * fine + 2 * more
    return np.asarray((np.arange(count) - (count - 1) / 2) / fine)


def _of_one_pupil(seen: Sequence[Seen]) -> list[list[int]]:
    """Return the frames in groups whose light is known at the same points of the pupil."""
    groups: list[list[int]] = []
    for frame, (pupil_m, _) in enumerate(seen):
        for group in groups:
            if np.array_equal(seen[group[0]][0], pupil_m):
                group.append(frame)
                break
        else:
            groups.append([frame])
    return groups


def pixel_rule(highest: float) -> Array:
    """Return weights of samples, those of a pixel and `BESIDE` on each side, whose sum is the mean over the pixel.

    Right to `RULE_ERROR`, by as few samples as that takes, for intensities whose frequencies reach up to `highest`
    periods per pixel and fall off towards it as those behind a slit do: least squares of the sum's response to the
    pixel's, sinc(f). A mean of samples would need twice as many each way.
    """
    return _rule(round(float(highest) + 0.005, 2))


@lru_cache(maxsize=256)
def _rule(highest: float) -> Array:
    f = np.linspace(0, highest, 400)
    trust = 1 - f / highest
    weights = np.ones(1)
    for samples in range(2, MOST_SAMPLES + 1):
        places = _offsets(1, samples, BESIDE)
        half = places[places >= -1e-12]  # a rule is symmetric: x and -x together
        response = np.cos(2 * np.pi * np.outer(f, half)) * np.where(half > 1e-12, 2.0, 1.0)
        found = np.linalg.lstsq(response * trust[:, None], np.sinc(f) * trust, rcond=1e-6)[0]
        off = (response @ found - np.sinc(f)) * trust
        weights = np.concatenate([found[::-1], found[1:] if len(places) % 2 else found])
        if float(np.sqrt(np.mean(off**2) / np.mean(trust**2))) <= RULE_ERROR:
            break
    return weights


def _pixel_means(pixels: int, rule: Array) -> Array:
    """Return the weights (pixels, samples) of the mean over each pixel of a row's samples."""
    fine = len(rule) - 2 * BESIDE
    weights = np.zeros((pixels, pixels * fine + 2 * BESIDE))
    for pixel in range(pixels):
        weights[pixel, pixel * fine : pixel * fine + len(rule)] = rule
    return weights
