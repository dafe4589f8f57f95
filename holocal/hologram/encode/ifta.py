"""Phase-only encoding by the iterative Fourier transform algorithm (thesis 3.1; 10 iterations).

On the panel the modulus is 1. In the pupil's plane, the Fourier transform of the field divided by the reference, the
wanted field stands inside the signal window (the pupil); outside it, where no eye looks, the field is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from holocal.hologram.encode.fourier import WindowedTransform


@dataclass(frozen=True)
class Encoded:
    """A field of unit modulus and how well it does.

    `field` (rows, columns) complex64; `efficiency` is the share of its light that is wanted signal: in the window and
    in proportion to the wanted field; `in_window` the share in the window; `signal_error` after each iteration,
    starting with the hologram's own phase: rms error over rms of the scaled wanted field, inside the window.
    """

    field: torch.Tensor
    efficiency: float
    in_window: float
    signal_error: tuple[float, ...]


def unit_modulus(field: torch.Tensor) -> torch.Tensor:
    """Divide a complex field by its modulus in place, and return it; 0 stays 0."""
    parts = torch.view_as_real(field)
    square = torch.mul(parts[..., 0], parts[..., 0]).addcmul_(parts[..., 1], parts[..., 1])
    parts.mul_(square.clamp_(min=1e-30).rsqrt_().unsqueeze(-1))
    return field


def ifta(
    start: torch.Tensor, wanted: torch.Tensor, window: torch.Tensor, transform: WindowedTransform, *, iterations: int
) -> Encoded:
    """Return the phase-only field whose spectrum in the window is nearest to the wanted one.

    Each iteration adds to the field what its spectrum lacks in the window, which leaves the rest of the spectrum free,
    and divides by the modulus. The wanted field's scale is the real factor that fits it best at each iteration.

    Parameters
    ----------
    start
        (rows, columns) complex64, the full-complex hologram divided by the reference; overwritten.
    wanted, window
        Compact spectra of `transform`: the wanted field, and where it is asked for (bool).
    transform
        To the window and back.
    iterations
        How many; 0 keeps the phase of `start`.
    """
    field, mask = unit_modulus(start), window.to(torch.float32).unsqueeze(-1)
    wanted = wanted * window
    power = max(_power(wanted), 1e-30)
    errors, signal, inside = [], 0.0, 0.0
    found = transform.forward(field)
    for step in range(iterations + 1):
        torch.view_as_real(found).mul_(mask)
        scale = float(torch.vdot(wanted.flatten(), found.flatten()).real) / power
        signal, inside = scale * scale * power, _power(found)
        found.sub_(wanted, alpha=scale)
        errors.append((_power(found) / max(signal, 1e-30)) ** 0.5)
        if step < iterations:
            found = transform.update(field, found, unit_modulus)
    return Encoded(field, signal / field.numel(), inside / field.numel(), tuple(errors))


def _power(spectrum: torch.Tensor) -> float:
    return float(torch.linalg.vector_norm(torch.view_as_real(spectrum))) ** 2
