"""What a hologram is made for: panel, bench, colour, field and the engine's choices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, pi

from holocal.errors import UsageError
from holocal.hologram.wavefront import Wavefront
from holocal.optics.bench import Bench, Panel


@dataclass(frozen=True)
class Warped:
    """The panel in patches of warped coordinates (docs/physics.md 4): no borders in the image. The default.

    `accuracy_rad` is the wavefront error asked for, rms over points and footprints: patches and transforms are chosen
    from it, and the hologram's relative L2 distance from the direct sum stays below it.
    """

    accuracy_rad: float = 0.1


@dataclass(frozen=True)
class Zones:
    """The thesis's method: `count` x `count` zones of the field share a wavefront up to tilt; 1.5 rad for 5 x 5."""

    count: int = 5


@dataclass(frozen=True)
class Direct:
    """The sum over points of their exact phase functions, in float64: what the other methods are measured against."""


Method = Warped | Zones | Direct


@dataclass(frozen=True)
class HologramSettings:
    """Everything a hologram needs besides scene and seed; hashable, so tables are made once per setting.

    Parameters
    ----------
    panel, bench
        The panel, and the bench as the engine believes it to be: nominal, or as calibrated.
    wavelength_m
        Wavelength in metres.
    fov_rad
        Full angles (x, y) that the scene covers, radians; rectilinear, centred on the gaze.
    gaze_rad
        Gaze angles (x, y): the pupil moves with them.
    depth_m
        Distance of an image from the pupil's centre; infinite by default.
    method
        How the points are summed: `Warped`, `Zones` or `Direct`.
    iterations
        IFTA iterations (thesis: 10); 0 keeps the phase of the full-complex hologram.
    device
        torch device of the heavy arrays. The non-uniform Fourier transforms stay on the CPU.
    wavefront
        A correction added to the points' phase functions; None adds nothing.
    """

    panel: Panel
    bench: Bench
    wavelength_m: float
    fov_rad: tuple[float, float]
    gaze_rad: tuple[float, float] = (0.0, 0.0)
    depth_m: float = inf
    method: Method = Warped()
    iterations: int = 10
    device: str = "cpu"
    wavefront: Wavefront | None = None

    def __post_init__(self) -> None:
        accuracy = self.method.accuracy_rad if isinstance(self.method, Warped) else 1.0
        zones = self.method.count if isinstance(self.method, Zones) else 1
        limits: tuple[tuple[str, float, bool, str], ...] = (
            ("wavelength_m", self.wavelength_m, 1e-8 < self.wavelength_m < 1e-4, "between 1e-8 and 1e-4 m"),
            ("fov_rad", max(self.fov_rad), all(0 < f < 0.75 * pi for f in self.fov_rad), "0 to 135 degrees"),
            ("gaze_rad", max(self.gaze_rad), all(abs(g) < pi / 3 for g in self.gaze_rad), "within 60 degrees"),
            ("depth_m", self.depth_m, self.depth_m >= 1e-6, "at least 1e-6 m"),
            ("zones", zones, 1 <= zones <= 64, "1 to 64"),
            ("accuracy_rad", accuracy, 1e-3 <= accuracy <= 10, "0.001 to 10 rad"),
            ("iterations", self.iterations, 0 <= self.iterations <= 1000, "0 to 1000"),
        )
        for key, value, holds, limit in limits:
            if not holds:
                raise UsageError(f"{key} is {value:g}; it must be {limit}.", measured=value, limit=limit)

    def geometry(self) -> HologramSettings:
        """Return settings that agree in all that the reference and the pupil's window depend on, and in the device.

        Tables are kept by them: a scene at another depth, or by another method, finds those of the last one.
        """
        plain = HologramSettings(self.panel, self.bench, self.wavelength_m, (0.1, 0.1), self.gaze_rad)
        return replace(plain, device=self.device)

    def of_plans(self) -> HologramSettings:
        """Return settings that agree in all that the warped engine's plans depend on, others at one value."""
        return replace(self, depth_m=inf, iterations=0, device="cpu")
