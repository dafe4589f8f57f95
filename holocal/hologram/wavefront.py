"""A wavefront correction: Zernike coefficients over the pupil that vary smoothly over the field."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np

from holocal.errors import InputError
from holocal.optics.bench import Array
from holocal.optics.series import chebyshev_products
from holocal.optics.zernike import zernike


@dataclass(frozen=True)
class Wavefront:
    """sum_j c_j(t) Z_j(q / pupil radius), radians at `wavelength_m`, added to the phase function of a point.

    To cancel an aberration W (a delay, radians) that the bench adds, give -W. The correction is a length of path: at
    another wavelength its phase scales with the inverse wavelength.

    Parameters
    ----------
    noll
        Noll indices j.
    coefficients_rad
        One tuple per Noll index: the Chebyshev coefficients of c_j(t) in the tangents t / `half_tan`, products of total
        degree up to `degree`, in the order of `field_basis`.
    half_tan
        Half width (x, y) of the field in tangents where the series holds; beyond it the edge's value does.
    degree
        Total degree over the field.
    wavelength_m
        Where the radians are meant.
    """

    noll: tuple[int, ...]
    coefficients_rad: tuple[tuple[float, ...], ...]
    half_tan: tuple[float, float]
    degree: int
    wavelength_m: float

    def __post_init__(self) -> None:
        terms = (self.degree + 1) * (self.degree + 2) // 2
        if len(self.coefficients_rad) != len(self.noll) or any(len(c) != terms for c in self.coefficients_rad):
            raise InputError(
                f"A wavefront of {len(self.noll)} Zernike terms and degree {self.degree} over the field needs "
                f"{len(self.noll)} x {terms} coefficients.",
            )
        if not all(isfinite(c) for row in self.coefficients_rad for c in row):
            raise InputError("A coefficient of the wavefront correction is not finite.")
        if not (all(j >= 1 for j in self.noll) and min(*self.half_tan, self.wavelength_m) > 0 and self.degree >= 0):
            raise InputError(
                f"A wavefront of Noll indices {self.noll}, half width {self.half_tan}, degree {self.degree} and "
                f"wavelength {self.wavelength_m:g} m has no meaning.",
                fix="Noll indices start at 1; widths and the wavelength are above 0, the degree is not negative.",
            )

    def is_identity(self) -> bool:
        """Return whether it changes nothing."""
        return not any(any(row) for row in self.coefficients_rad)

    def phase(self, field_tan: Array, pupil_m: Array, *, pupil_diameter_m: float, wavelength_m: float) -> Array:
        """Return the phase to add, (...) radians at `wavelength_m`, for tangents and pupil points (..., 2) in P.

        Outside the pupil the value on its rim in the same direction holds: nothing grows where no light should go.
        """
        field_tan, pupil_m = np.broadcast_arrays(field_tan, pupil_m)
        over_field = (
            field_basis(field_tan.reshape(-1, 2), self.half_tan, self.degree) @ np.asarray(self.coefficients_rad).T
        )
        local = pupil_m.reshape(-1, 2) / (pupil_diameter_m / 2)
        local = local / np.maximum(1.0, np.linalg.norm(local, axis=-1, keepdims=True))
        over_pupil = zernike(self.noll, local[:, 0], local[:, 1])
        phase = np.einsum("ij,ji->i", over_field, over_pupil) * (self.wavelength_m / wavelength_m)
        return np.asarray(phase.reshape(field_tan.shape[:-1]))


def field_basis(field_tan: Array, half_tan: tuple[float, float], degree: int) -> Array:
    """Return the Chebyshev products of total degree up to `degree` at tangents (n, 2), (n, terms); edges held."""
    x, y = (np.clip(field_tan[:, axis] / half_tan[axis], -1, 1) for axis in (0, 1))
    return chebyshev_products(x, y, degree)
