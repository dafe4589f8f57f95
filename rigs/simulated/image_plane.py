"""The field along directions, from the field in the pupil: light that goes on to where the panel's image lies.

    E(s) = 1 / wavelength  integral U(q) exp(i k q . s) dq                      s = direction sines in P

The grid holds V, U without the mean wave exp(-i k (c . q + q . C q / 2)). A camera focused at f adds 1 / f to C. With
X = C^-1 (s - c), completing the square makes E, up to a phase of s alone, the convolution of V with
exp(-i k X . C X / 2): one Fourier transform, a product with exp(i pi lambda f . C^-1 f), and one non-uniform transform
back (FINUFFT type 2). Nothing is left out. V needs a fourth of the samples of U at 4K and a fiftieth for a small panel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.fft
import torch
from numpy.typing import NDArray

from holocal.optics.bench import Array
from rigs.simulated.pupil import Complex, PupilGrid, unit_phase

NUFFT_EPS = 1e-3  # relative, of the field


class ImagePlane:
    """The plane of X, for one pupil grid, wavelength and focus.

    `bounds` are direction sines (x, y) in P between which all directions lie that will be asked for: the transform is
    periodic, and nothing of what it wraps round may fall there.
    """

    def __init__(
        self, grid: PupilGrid, wavelength_m: float, bounds: tuple[Array, Array], *, focus_m: float = np.inf
    ) -> None:
        self._grid, k = grid, 2 * np.pi / wavelength_m
        xx, xy, yy = grid.curvature_per_m
        self._inverse = np.linalg.inv(np.array([[xx + 1 / focus_m, xy], [xy, yy + 1 / focus_m]]))
        spread = np.array([wavelength_m / (2 * pitch) for pitch in grid.pitch_m])
        self._light_m = np.array([grid.x_m[-1], grid.y_m[-1]]) + np.abs(self._inverse) @ spread
        seen = np.minimum([np.abs(place).max() for place in self._places(bounds)], self._light_m)
        self._size = [
            int(scipy.fft.next_fast_len(max(int(np.ceil(reach / pitch)), len(places))))
            for reach, pitch, places in zip(self._light_m + seen, grid.pitch_m, (grid.x_m, grid.y_m), strict=True)
        ]
        f_x, f_y = (
            np.asarray(np.fft.fftfreq(n, pitch), np.float64) for n, pitch in zip(self._size, grid.pitch_m, strict=True)
        )
        self._transfer = torch.from_numpy(self._transfer_function(f_x, f_y, wavelength_m))
        self._power_per_square = float(np.linalg.det(self._inverse)) / (self._size[0] * self._size[1]) ** 2
        self._focus: Complex | None = None
        if np.isfinite(focus_m):  # what a point at that distance sends, exp(+i k |p - q|), less its quadratic part
            sq = grid.x_m[None] ** 2 + grid.y_m[:, None] ** 2
            self._focus = unit_phase(-k * sq * (1 / (np.sqrt(focus_m**2 + sq) + focus_m) - 0.5 / focus_m))

    def _transfer_function(self, f_x: Array, f_y: Array, wavelength_m: float) -> Complex:
        """Return exp(i pi lambda f . C^-1 f), (len(f_y), len(f_x)), in bands: the whole in float64 is large."""
        (xx, xy), (_, yy) = np.pi * wavelength_m * self._inverse
        out = np.empty((len(f_y), len(f_x)), np.complex64)
        along = xx * f_x * f_x
        for low in range(0, len(f_y), 128):
            y = f_y[low : low + 128, None]
            out[low : low + 128] = unit_phase(along + 2 * xy * f_x * y + yy * y * y)
        return out

    def _places(self, sines: tuple[Array, Array]) -> list[Array]:
        dx, dy = sines[0] - self._grid.carrier[0], sines[1] - self._grid.carrier[1]
        return [row[0] * dx + row[1] * dy for row in self._inverse]

    def phases(self, sines: tuple[Array, Array]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """Return the coordinates (x, y) of directions for `plan`, in [-pi, pi], and which the panel sends light along.

        Where it sends none the coordinates are 0, and the field that comes out means nothing.
        """
        places = self._places(sines)
        lit = np.ones(places[0].shape, np.bool_)
        for place, light in zip(places, self._light_m, strict=True):
            lit &= np.abs(place) <= light
        out = []
        for place, pitch, size, first in zip(
            places, self._grid.pitch_m, self._size, (self._grid.x_m[0], self._grid.y_m[0]), strict=True
        ):
            turns = (place - first) * (1 / (size * pitch))
            turns -= np.rint(turns)
            turns *= 2 * np.pi
            turns[~lit] = 0.0
            out.append(turns.astype(np.float32))
        return out[0], out[1], lit

    def plan(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> Any:
        """Return the plan that takes a `spectrum` to points of `phases`, (n,)."""
        import finufft

        plan = finufft.Plan(
            2,
            (self._size[1], self._size[0]),
            eps=NUFFT_EPS,
            isign=1,
            upsampfac=1.25,  # half the memory of 2, and no slower
            spread_sort=0,  # a picture's points lie in order already
            dtype="complex64",
            nthreads=torch.get_num_threads(),
            modeord=1,  # frequencies as the transform leaves them
        )
        plan.setpts(y, x)
        return plan

    def spectrum(self, field: Complex) -> Complex:
        """Return what `plan` takes, of a field (rows, columns) as `PanelToPupil.field` gives it."""
        wave, workers = field if self._focus is None else field * self._focus, torch.get_num_threads()
        # one axis after the other, the rows that are all zero left out: half the time of torch's padded transform
        columns = scipy.fft.fft(wave, n=self._size[1], axis=0, workers=workers)
        whole = scipy.fft.fft(columns, n=self._size[0], axis=1, workers=workers)
        return np.asarray(torch.from_numpy(whole).mul_(self._transfer).numpy())

    @property
    def power_per_square(self) -> float:
        """The power per d^2 s of a value 1 of |what comes out of the plan|^2."""
        return self._power_per_square


def field_along(
    grid: PupilGrid, field: Complex, wavelength_m: float, sines: tuple[Array, Array], *, focus_m: float = np.inf
) -> NDArray[np.complex64]:
    """Return E(s), up to a phase of each direction, (n,), along directions (n,): |E|^2 is power per d^2 s."""
    plane = ImagePlane(grid, wavelength_m, sines, focus_m=focus_m)
    x, y, lit = plane.phases(sines)
    found = plane.plan(x, y).execute(plane.spectrum(field)) * np.sqrt(plane.power_per_square)
    return np.asarray(np.where(lit, found, 0), np.complex64)
