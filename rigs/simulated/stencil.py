"""What a patch's separable form leaves of its wave, made up for by sums over neighbouring samples in the pupil.

The light of the panel point x turns by theta = step . d(u(q) . g(x)) / dq from one sample of the pupil to the next. A
factor sin theta is therefore half a difference of a sample's neighbours over i, and 2 - 2 cos theta twice the sample
less its neighbours. What the form leaves of the phase is nearly quadratic in x, what it leaves of the amplitude nearly
linear, with factors that vary over the pupil: a stencil of three by three samples takes away all but a tenth of both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array
from rigs.simulated.kernel import (
    Q_NODES,
    X_NODES,
    PatchKernel,
    Polynomial,
    interpolate,
    panel_weight,
    pupil_weight,
)
from rigs.simulated.pupil import Complex

Factors = tuple[NDArray[np.float32], ...]


@dataclass(frozen=True)
class Stencil:
    """The amplitude as a product, and the factors over the pupil of what is left.

    The amplitude is `from_panel` (over the patch, mean 1) times `to_pupil`, plus `first` times sin theta along x and y;
    to the phase comes `constant`, and `second` times 2 - 2 cos theta along x, along y, and sin theta_x sin theta_y.
    `residual` is the relative rms error of the field that is left.
    """

    from_panel: Polynomial
    to_pupil: Polynomial
    constant: Polynomial
    first: tuple[Polynomial, Polynomial]
    second: tuple[Polynomial, Polynomial, Polynomial]
    residual: float


def fit_stencil(kernel: PatchKernel, amplitude: Array, step_m: tuple[float, float]) -> Stencil:
    """Return the stencil of a patch, least squares over it, for steps along x and y.

    `amplitude` (panel nodes, pupil nodes) is what a pixel sends to the pupil.
    """
    pupil, weight = kernel.beta.box, panel_weight()
    over = pupil_weight(pupil)
    a, b = _product(amplitude, weight, over)
    turn_x, turn_y = _turns(kernel, step_m)
    waves = [np.sin(turn_x), np.sin(turn_y)]
    first, of_amplitude = _least_squares(waves, (amplitude - np.outer(a, b)).T, weight)
    waves = [np.ones_like(turn_x), 2 - 2 * np.cos(turn_x), 2 - 2 * np.cos(turn_y), np.sin(turn_x) * np.sin(turn_y)]
    second, of_phase = _least_squares(waves, kernel.rest_rad.T, weight)

    def over_pupil(values: Array) -> Polynomial:
        return interpolate(pupil, values.reshape(Q_NODES, Q_NODES))

    return Stencil(
        from_panel=interpolate(kernel.alpha.box, a.reshape(X_NODES, X_NODES)),
        to_pupil=over_pupil(b),
        constant=over_pupil(second[0]),
        first=(over_pupil(first[0]), over_pupil(first[1])),
        second=(over_pupil(second[1]), over_pupil(second[2]), over_pupil(second[3])),
        residual=float(np.sqrt((of_amplitude + b**2 * of_phase) @ over / (b**2 @ over))),
    )


def _product(values: Array, weight_x: Array, weight_q: Array) -> tuple[Array, Array]:
    """Return a(x) and b(q), a of mean 1, whose product is nearest to values at the nodes."""
    root = np.sqrt(weight_x)
    a = np.linalg.svd(root[:, None] * values * np.sqrt(weight_q), full_matrices=False)[0][:, 0] / root
    a = a / (a @ weight_x)
    return np.asarray(a), np.asarray((a * weight_x) @ values / (a**2 @ weight_x))


def _turns(kernel: PatchKernel, step_m: tuple[float, float]) -> tuple[Array, Array]:
    """Return theta for steps along x and along y, (pupil nodes, panel nodes) each."""
    q = kernel.beta.box.nodes(Q_NODES)
    x = kernel.alpha.box.nodes(X_NODES)
    g_x, g_y = (part.on_grid(*x).ravel() for part in (kernel.gx, kernel.gy))
    turns = [
        step * (np.outer(along_x.ravel(), g_x) + np.outer(along_y.ravel(), g_y))
        for step, along_x, along_y in zip(step_m, kernel.ux.gradient(*q), kernel.uy.gradient(*q), strict=True)
    ]
    return turns[0], turns[1]


def _least_squares(waves: list[Array], wanted: Array, weight: Array) -> tuple[Array, Array]:
    """Return the factors (waves, pupil nodes) and the mean square that they leave at each pupil node."""
    root = np.sqrt(weight)[:, None]
    system, target = root * np.stack(waves, axis=-1), root * wanted[..., None]
    found = np.linalg.pinv(system) @ target
    return np.asarray(found[..., 0].T), np.asarray(np.sum((system @ found - target)[..., 0] ** 2, axis=1))


def apply(piece: Complex, to_pupil: NDArray[np.float32], first: Factors, second: Factors) -> None:
    """Give a patch's field at its samples, (columns, rows), its amplitude, and make up for what the form leaves.

    In place. The factors of the stencil belong to the inner samples; the outermost ring is left without.
    """
    inner, right, left = piece[1:-1, 1:-1], piece[2:, 1:-1], piece[:-2, 1:-1]
    up, down = piece[1:-1, 2:], piece[1:-1, :-2]
    twice = inner + inner
    bend = twice - right
    bend -= left
    bend *= second[0]
    twice -= up
    twice -= down
    twice *= second[1]
    bend += twice
    np.subtract(piece[:-2, 2:], piece[:-2, :-2], out=twice)
    twice += piece[2:, :-2]
    twice -= piece[2:, 2:]
    twice *= second[2]  # sin sin is a fourth of this
    bend += twice
    slope = left - right  # i times half of it is the sine's
    slope *= first[0]
    np.subtract(down, up, out=twice)
    twice *= first[1]
    slope += twice
    inner.real -= bend.imag
    inner.imag += bend.real
    piece *= to_pupil
    inner.real -= slope.imag
    inner.imag += slope.real
