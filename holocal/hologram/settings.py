"""What a hologram is made for: panel, bench, colour, field and the engine's choices."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

from holocal.errors import UsageError
from holocal.optics.bench import Bench, Panel


@dataclass(frozen=True)
class HologramSettings:
    """Everything `render_image` needs besides the image and the seed; hashable, so tables are made once per setting.

    Parameters
    ----------
    panel, bench
        The panel, and the bench as the engine believes it to be: nominal, or as calibrated.
    wavelength_m
        Wavelength in metres.
    fov_rad
        Full angles (x, y) that the image covers, radians; rectilinear, centred on the gaze.
    gaze_rad
        Gaze angles (x, y): the pupil moves with them.
    depth_m
        Distance of the image from the pupil's centre; infinite by default.
    zones
        The field is divided in zones x zones that share a wavefront up to tilt (thesis 3.1).
    warped
        Patches of the panel in warped coordinates (docs/physics.md 4): 0.05 rad rms of wavefront error and no borders
        in the image; `zones` is not used then. False is the thesis's own method, 1.5 rad in 5 x 5 zones.
    iterations
        IFTA iterations (thesis: 10); 0 keeps the phase of the full-complex hologram.
    device
        torch device of the heavy arrays. The non-uniform Fourier transforms stay on the CPU.
    """

    panel: Panel
    bench: Bench
    wavelength_m: float
    fov_rad: tuple[float, float]
    gaze_rad: tuple[float, float] = (0.0, 0.0)
    depth_m: float = inf
    zones: int = 5
    warped: bool = True
    iterations: int = 10
    device: str = "cpu"

    def __post_init__(self) -> None:
        limits: tuple[tuple[str, float, bool, str], ...] = (
            ("wavelength_m", self.wavelength_m, 1e-8 < self.wavelength_m < 1e-4, "between 1e-8 and 1e-4 m"),
            ("fov_rad", max(self.fov_rad), all(0 < f < 0.75 * pi for f in self.fov_rad), "0 to 135 degrees"),
            ("gaze_rad", max(self.gaze_rad), all(abs(g) < pi / 3 for g in self.gaze_rad), "within 60 degrees"),
            ("depth_m", self.depth_m, self.depth_m > 0, "above 0 m"),
            ("zones", self.zones, 1 <= self.zones <= 64, "1 to 64"),
            ("iterations", self.iterations, 0 <= self.iterations <= 1000, "0 to 1000"),
        )
        for key, value, holds, limit in limits:
            if not holds:
                raise UsageError(f"{key} is {value:g}; it must be {limit}.", measured=value, limit=limit)
