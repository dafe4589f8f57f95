"""The direct sum over points of their exact phase functions: the judge of the other methods, and a method itself.

    H(x) = sum_p A_p(x) a_p exp(i [psi_p + phi_p(x) - psi0(x)])

with A_p the pupil's soft-edged image (`footprint.transmission`), a_p and psi_p amplitude and initial phase, and psi0
the reference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from holocal.errors import SamplingError
from holocal.hologram.encode.blocks import in_blocks
from holocal.hologram.footprint import EDGE_M, transmission
from holocal.hologram.phase_model import wanted_phase
from holocal.hologram.reference import reference_turns
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import HologramSettings
from holocal.optics.bench import Array
from holocal.optics.phase_function import VirtualPoints
from holocal.optics.series import Series, fit_series

_PAIRS = 200_000  # traced at a time
_DEGREES = (16, 32, 64)  # of a point's phase and pupil over the panel: 16 leaves 1e-4 rad on the 4K panel
_TAIL_RAD = 1e-2  # in the last two degrees together; what is left beyond is smaller still
_BLOCK = 16  # rows at a time, float64 work that stays in the cache


def direct_sum(settings: HologramSettings, clouds: Sequence[PointCloud], slm_m: Array) -> NDArray[np.complex128]:
    """Return the hologram divided by the reference at panel points (k, 2): every ray is traced, in float64.

    0.5 s for a million pairs of point and panel point on one core.
    """
    reference = reference_turns(settings).at(slm_m)
    total = np.zeros(len(slm_m), np.complex128)
    for cloud in clouds:
        lit = cloud.lit()
        step = max(1, _PAIRS // max(1, len(slm_m)))
        for first in range(0, len(lit), step):
            part = lit.part(np.arange(first, min(first + step, len(lit))))
            points = VirtualPoints(part.field_tan[:, None], part.distance_m[:, None])
            found = wanted_phase(settings, points, slm_m)
            footprint = transmission(found.pupil_m, settings.bench.pupil_diameter_m, part.aperture)
            turns = found.phase_rad / (2 * np.pi) - reference
            phase = 2 * np.pi * (turns - np.round(turns)) + part.phase_rad[:, None]
            total += np.sum(part.amplitude[:, None] * footprint * np.exp(1j * phase), axis=0)
    return total


def direct_hologram(
    settings: HologramSettings, clouds: Sequence[PointCloud], out: NDArray[np.complex64] | None = None
) -> NDArray[np.complex64]:
    """Return the hologram divided by the reference on all pixels of the panel, (height, width), added to `out`.

    Each point's phase and pupil point are traced at the nodes of a Chebyshev series over the panel and interpolated,
    1e-4 rad off: three to five FFT pairs of the panel's size per point.

    Raises
    ------
    SamplingError
        A point is so near that its phase is not smooth over the panel.
    """
    panel = settings.panel
    reference = reference_turns(settings)
    total = np.zeros((panel.height, panel.width), np.complex64) if out is None else out
    for cloud in clouds:
        lit = cloud.lit()
        for i in range(len(lit)):
            _add_wave(total, settings, lit.part(np.array([i])), reference)
    return total


def _add_wave(total: NDArray[np.complex64], settings: HologramSettings, one: PointCloud, reference: Series) -> None:
    """Add a point's wave to the panel's field, row by row block where its footprint is."""
    panel, diameter = settings.panel, settings.bench.pupil_diameter_m
    wave = _wave(settings, one, reference)
    in_y, in_x = wave.bases(panel.x_m, panel.y_m)
    tables = [wave.coefficients[..., k] @ in_x.T for k in range(3)]
    reach = diameter / 2 + EDGE_M

    def add(part: slice) -> None:
        rows = in_y[part]
        x, y = (np.asarray(rows @ tables[k], np.float64) for k in (1, 2))
        near = np.hypot(x, y) <= reach
        if not near.any():
            return
        lit = np.flatnonzero(near.any(axis=0))
        columns = slice(int(lit[0]), int(lit[-1]) + 1)
        pupil = np.stack([x[:, columns], y[:, columns]], axis=-1)
        turns = rows @ tables[0][:, columns] + one.phase_rad[0] / (2 * np.pi)
        turns -= np.round(turns)
        phase = (2 * np.pi * turns).astype(np.float32)
        modulus = (one.amplitude[0] * transmission(pupil, diameter, one.aperture)).astype(np.float32)
        field = total[part, columns]
        field.real += modulus * np.cos(phase)
        field.imag += modulus * np.sin(phase)

    in_blocks(add, panel.height, _BLOCK)


def _wave(settings: HologramSettings, one: PointCloud, reference: Series) -> Series:
    """Return phase less reference (turns) and pupil point (x, y; metres) of one point, a series over the panel."""

    def traced(slm_m: Array) -> Array:
        found = wanted_phase(settings, VirtualPoints(one.field_tan, one.distance_m), slm_m)
        turns = found.phase_rad / (2 * np.pi) - reference.at(slm_m)
        return np.concatenate([turns[:, None], found.pupil_m], axis=1)

    half = settings.panel.half_size_m
    for degree in _DEGREES:
        found = fit_series(traced, degree=degree, centre=(0.0, 0.0), half=half)
        tail = np.abs(found.coefficients[-2:, :, 0]).sum() + np.abs(found.coefficients[:, -2:, 0]).sum()
        if tail * 2 * np.pi <= _TAIL_RAD:
            return found
    raise SamplingError(
        f"The phase of a point {one.distance_m[0]:.3g} m away is not smooth over the panel: polynomials of degree "
        f"{_DEGREES[-1]} leave {tail * 2 * np.pi:.2g} rad.",
        fix="Move the point farther away from the pupil.",
        measured=float(tail * 2 * np.pi),
        limit=_TAIL_RAD,
    )
