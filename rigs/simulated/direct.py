"""The plain sum over every pixel of the panel: what the rig must agree with.

    E(p) = pitch^2 / wavelength  sum_x u(x) conj(exp(i phi_p(x))) A_p(x)

with the exact phase function phi_p of each virtual point, from rays traced in float64, and A_p(x) the pupil's
transmission where the ray from x to p crosses it, diffracted over the way from the pupil to the panel's image, times
the square root of the Jacobian dq / dx that keeps the power (docs/physics.md 5 and 6). It shares with the rig the ray
trace and nothing else: no patches, no field in the pupil, no transforms of one. One point costs a pass over the panel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from holocal.errors import ConfigError
from holocal.optics.bench import Array, Bench, Panel
from holocal.optics.phase_function import VirtualPoints, exact_phase
from rigs.simulated.kernel import Box, interpolate
from rigs.simulated.pupil import Complex

NODES = 21  # Chebyshev nodes of the smooth functions over the panel, each way: 1e-4 rad left over the 4K panel
BAND = 128  # rows at a time
EDGE_SAMPLES = 12  # across the pupil's edge, of its profile; PROFILE_SHARE: what is computed, of the pupil's radius
PROFILE_SHARE = 1.5


@dataclass(frozen=True)
class DirectSum:
    """The plain sum for one bench, panel and wavelength.

    `before` is the light on the panel, (height, width), less its tilt (None: 1), `fill_factor` as the rig's file has
    it, `edge_m` the width over which the pupil's transmission falls.
    """

    bench: Bench
    panel: Panel
    wavelength_m: float
    edge_m: float
    before: NDArray[np.float32] | Complex | None = None
    fill_factor: float | None = None

    def field(self, modulation: Complex, points: VirtualPoints) -> NDArray[np.complex128]:
        """Return E, (n,), of a (height, width) modulation at n virtual points; |E|^2 is power per d^2 s.

        A point at a finite distance is what a camera focused there sees in its direction.
        """
        tangents, distances = points.field_tan.reshape(-1, 2), points.distance_m.ravel()
        profiles = {far: self._footprint(far) for far in set(distances.tolist())}
        return np.array(
            [self._one(modulation, tan, far, profiles[far]) for tan, far in zip(tangents, distances, strict=True)]
        )

    def _one(
        self, modulation: Complex, tangent: Array, distance_m: float, profile: tuple[Array, NDArray[np.complex128]]
    ) -> complex:
        half_x, half_y = self.panel.half_size_m
        box = Box(-half_x, half_x, -half_y, half_y)
        nodes = np.stack(np.meshgrid(*box.nodes(NODES)), axis=-1).reshape(-1, 2)
        found = exact_phase(self.bench, VirtualPoints.at(tangent, distance_m), nodes, wavelength_m=self.wavelength_m)
        if not found.error_m.max() < 1e-9:
            raise ConfigError(f"A ray towards the tangents {tangent} misses the panel by {found.error_m.max():.3g} m.")
        phase, pupil_x, pupil_y = (
            interpolate(box, part.reshape(NODES, NODES))
            for part in (found.phase_rad, found.pupil_m[:, 0], found.pupil_m[:, 1])
        )
        slopes = [pupil_x.gradient(*box.nodes(NODES)), pupil_y.gradient(*box.nodes(NODES))]
        spread = np.sqrt(np.abs(slopes[0][0] * slopes[1][1] - slopes[0][1] * slopes[1][0]))
        frequency = [part / (2 * np.pi) for part in phase.gradient(*box.nodes(NODES))]
        active, dead = (interpolate(box, spread * part) for part in self._pixel(*frequency))
        _, tilt = self.panel.illumination_frequency_per_m
        x, total = self.panel.x_m, 0j
        for low in range(0, self.panel.height, BAND):
            rows = slice(low, low + BAND)
            y = self.panel.y_m[rows]
            light = modulation[rows] * active.on_grid(x, y) + dead.on_grid(x, y)
            if self.before is not None:
                light = light * self.before[rows]
            turned = np.exp(1j * np.remainder(2 * np.pi * tilt * y[:, None] - phase.on_grid(x, y), 2 * np.pi))
            q = np.hypot(pupil_x.on_grid(x, y), pupil_y.on_grid(x, y)).ravel()
            passed = np.interp(q, *profile, right=0.0).reshape(turned.shape)
            total += np.sum(light * turned * passed)
        return complex(total * self.panel.pitch_m**2 / self.wavelength_m)

    def _pixel(self, f_x: Array, f_y: Array) -> tuple[Array, Array]:
        """Return what a pixel's active square and its dead frame send, per unit amplitude, towards frequencies."""
        if self.fill_factor is None:
            return np.ones_like(f_x), np.zeros_like(f_x)
        f_in_x, f_in_y = self.panel.illumination_frequency_per_m
        side, pitch = self.panel.pitch_m * np.sqrt(self.fill_factor), self.panel.pitch_m
        active = self.fill_factor * np.sinc(side * (f_x - f_in_x)) * np.sinc(side * (f_y - f_in_y))
        return active, np.sinc(pitch * (f_x - f_in_x)) * np.sinc(pitch * (f_y - f_in_y)) - active

    def _footprint(self, distance_m: float) -> tuple[Array, NDArray[np.complex128]]:
        """Return radii in the pupil, and there the transmission as its edge's diffraction leaves it on the panel.

        The panel's image lies at B behind the pupil, B the eye relief unless the point is near: T goes on to there as
        exp(-i B lambda / (4 pi) Laplacian) T, of which physics.md 6 writes the first order.
        """
        radius = self.bench.pupil_diameter_m / 2
        reach = 1 / (1 / self.bench.eye_relief_m + 1 / distance_m)
        step = self.edge_m / EDGE_SAMPLES
        count = int(scipy.fft.next_fast_len(int(np.ceil(2 * PROFILE_SHARE * (radius + self.edge_m) / step))))
        at = (np.arange(count) - count // 2) * step
        z = np.clip((radius - np.hypot(at[None], at[:, None])) / self.edge_m, -0.5, 0.5)
        spectrum = scipy.fft.fft2(0.5 + 0.5 * np.sin(np.pi * z), workers=2)
        f = np.fft.fftfreq(count, step)
        turn = np.exp(1j * np.pi * reach * self.wavelength_m * f**2)
        spectrum *= turn[:, None] * turn
        middle = count // 2
        across = scipy.fft.ifft2(spectrum, workers=2)[middle, middle:]
        return np.asarray(at[middle:], np.float64), np.asarray(across, np.complex128)


def relative_error(found: NDArray[np.complex128] | Complex, exact: NDArray[np.complex128]) -> float:
    """Return the rms difference of the intensities of two fields, relative to the rms of the second."""
    a, b = np.abs(found.astype(np.complex128)) ** 2, np.abs(exact) ** 2
    return float(np.sqrt(np.sum((a - b) ** 2) / np.sum(b * b)))
