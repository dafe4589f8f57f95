"""What a zone's fit is made of: the camera's noise, priors, counts, the order of the parameters, and the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holocal.optics.bench import Array


@dataclass(frozen=True)
class Noise:
    """The variance law of counts: `read_variance` + `gain` s + `flicker_squared` s^2, s the signal in counts.

    `faint` is what the model of a picture leaves in its dark parts, as a share of the brightest pixel.
    """

    read_variance: float
    gain: float
    flicker_squared: float = 0.0
    faint: float = 0.0

    def variance(self, signal: Array) -> Array:
        """Return the variance of counts whose expected signal is this."""
        lit = np.maximum(signal, 0.0)
        return np.asarray(self.read_variance + self.gain * lit + self.flicker_squared * lit**2)


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what is fitted along: radians, logarithms, metres, pixels."""

    wavefront_rad: float = 3.0  # of every mode
    higher_rad: float = 0.3  # of modes above `wanted_degree`
    log_amplitude: float = 0.5
    log_flux: float = 5.0
    shift_m: float = 0.4e-3
    log_power: float = 0.01
    tilt_px: float = 0.03
    blur_px2: float = 0.3
    affine: float = 0.02


@dataclass(frozen=True)
class ZoneData:
    """What the camera saw of a zone: `counts` (frames, rows, columns) less the dark level, `good` where they count.

    `scale` (frames,) is what the model's power is multiplied by: exposure times a guess of the flux.
    """

    counts: Array
    good: NDArray[np.bool_]
    scale: Array


@dataclass(frozen=True)
class Layout:
    """Where each parameter stands in the vector."""

    terms: int
    amplitude_terms: int
    frames: int

    @property
    def wavefront(self) -> slice:
        """Terms 1.. of the wavefront; piston is not seen."""
        return slice(0, self.terms - 1)

    @property
    def amplitude(self) -> slice:
        """Terms of the logarithm of the amplitude; the first is half the logarithm of the flux."""
        return slice(self.wavefront.stop, self.wavefront.stop + self.amplitude_terms)

    @property
    def shift(self) -> slice:
        """Where the pupil lies, in millimetres."""
        return slice(self.amplitude.stop, self.amplitude.stop + 2)

    @property
    def power(self) -> slice:
        """Logarithm of each frame's power, the first frame's left out."""
        return slice(self.shift.stop, self.shift.stop + self.frames - 1)

    @property
    def tilt(self) -> slice:
        """Each frame's own shift in pixels (x, y), the first frame's left out."""
        return slice(self.power.stop, self.power.stop + 2 * (self.frames - 1))

    @property
    def blur(self) -> int:
        """Half the variance of the blur, pixels squared."""
        return int(self.tilt.stop)

    @property
    def affine(self) -> slice:
        """How the picture is stretched and turned about the window's middle: d(x, y) / d(x, y), row by row."""
        return slice(self.blur + 1, self.blur + 5)

    @property
    def count(self) -> int:
        """Length of the vector."""
        return int(self.affine.stop)


@dataclass(frozen=True)
class ZoneFit:
    """A zone's fit: `vector` and its `covariance` (Laplace, prior included) in the order of `layout`.

    `information` is that of the wavefront's terms alone, from the data: nuisances are integrated out with their prior,
    the wavefront's own prior is left out. `weighted` is information times what the data alone want.
    `chi2` is the reduced chi-square, `light` the signal's sum in counts.
    """

    layout: Layout
    vector: Array
    covariance: Array
    information: Array
    weighted: Array
    chi2: float
    pixels: int
    light: float
    converged: bool

    @property
    def wavefront_rad(self) -> Array:
        """Legendre coefficients of the wavefront, (terms - 1,), without piston."""
        return self.vector[self.layout.wavefront]
