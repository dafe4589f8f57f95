"""The accepted phase response of a panel: where it holds, and what is said where it does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.records.calibration import Accepted

RESPONSE = "response"
PHASE = "correction.phase_rad"
MOST_LEVELS = 256
SAME_LINE_NM = 2.0  # a phase response is of one line: panels have a table per colour, and a crystal's index disperses


@dataclass(frozen=True)
class PhaseResponse:
    """The phase of each level, (2**bits,) radians, and the line that it was measured at; None: at any."""

    phase_rad: NDArray[np.float64]
    wavelength_nm: float | None = None

    def is_identity(self) -> bool:
        """Return whether level L stands for 2 pi L / 256: nothing to correct."""
        count = len(self.phase_rad)
        linear = np.arange(count) * (2 * np.pi / count)
        return count == MOST_LEVELS and bool(np.allclose(self.phase_rad, linear, atol=1e-6))

    def at(self, wavelength_nm: float) -> NDArray[np.float64] | None:
        """Return the table where it holds for a line, else None."""
        measured = self.wavelength_nm
        return self.phase_rad if measured is None or abs(measured - wavelength_nm) <= SAME_LINE_NM else None

    def left_out(self, wavelength_nm: float) -> str:
        """Return why the table is not used at a line; empty where it is."""
        if self.at(wavelength_nm) is not None:
            return ""
        return f"the accepted {RESPONSE}: measured at {self.wavelength_nm:g} nm, not at {wavelength_nm:g} nm"


def response_of(accepted: Accepted) -> PhaseResponse:
    """Return the response that a run measured.

    Raises
    ------
    InputError
        It has not the channel that the procedure promises, with a power of two of finite phases.
    """
    values = accepted.maps.channels.get(PHASE)
    count = 0 if values is None else values.size
    if values is None or not 2 <= count <= MOST_LEVELS or count & (count - 1) or not np.all(np.isfinite(values)):
        raise InputError(
            f"the {accepted.procedure} calibration {accepted.entry} has no channel {PHASE} with a finite phase for "
            f"each of 2 to {MOST_LEVELS} levels, a power of two.",
            fix="Measure it again, or use `--corrections none`.",
            measured=count,
            limit=MOST_LEVELS,
        )
    line = accepted.maps.metadata.get("wavelength_nm", accepted.result.get("wavelength_nm"))
    at_nm = float(line) if isinstance(line, (int, float)) else None
    return PhaseResponse(np.asarray(values, np.float64).ravel(), at_nm)
