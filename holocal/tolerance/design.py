"""The bench as it is drawn, and the light that its own hologram sends: what every built bench is held against.

The rays of a direction p leave the panel where and how the nominal hologram sends them, phi_p(x) and its slope. They
are the same for every built bench, so they are found once (docs/tolerance.md 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from holocal.hologram.footprint import transmission
from holocal.optics.bench import Array, Bench, Panel, image_tangents
from holocal.optics.phase_function import VirtualPoints, exact_phase, trace_points
from holocal.records.rig_model import SimulatedRig
from holocal.units import DEGREE, MM, NM, UM

FIELD = 15  # directions along each side of the field, in the middles of its cells
MARGIN = 4  # more of them beyond each side: a picture that is seen elsewhere is sent from there
SENT = FIELD + 2 * MARGIN
PANEL = (25, 15)  # points of the panel
LANDED_M = 1e-9


@dataclass(frozen=True)
class Design:
    """A bench as it is drawn; hashable, and a few hundred bytes to send to another process.

    `field_rad` (width, height) is the camera's field and `camera_px` its pixels. `waist_m` is the 1/e^2 radius of the
    beam's intensity on the panel, infinite where it is even; `active_m` the side of a pixel's modulating square, 0 for
    point-like pixels.
    """

    panel: Panel
    pupil_diameter_m: float
    eye_relief_m: float
    wavelength_m: float
    field_rad: tuple[float, float]
    camera_px: tuple[int, int]
    waist_m: float = np.inf
    active_m: float = 0.0

    @property
    def bench(self) -> Bench:
        """The nominal bench."""
        return Bench.nominal(pupil_diameter_m=self.pupil_diameter_m, eye_relief_m=self.eye_relief_m)

    @property
    def pixel_tan(self) -> float:
        """A camera pixel, in tangents."""
        return float(2 * np.tan(self.field_rad[0] / 2) / self.camera_px[0])

    @property
    def half_tan(self) -> tuple[float, float]:
        """Half the width and height of the field, in tangents."""
        return float(np.tan(self.field_rad[0] / 2)), float(np.tan(self.field_rad[1] / 2))

    def seen_directions(self) -> Array:
        """Return the directions in which the eye looks for light, (FIELD^2, 2) tangents, rows from the top."""
        return np.stack(np.meshgrid(*image_tangents(FIELD, FIELD, self.field_rad)), axis=-1).reshape(-1, 2)

    def sent_directions(self) -> Array:
        """Return the directions that light is sent along, (SENT^2, 2): those of the field and MARGIN beyond it."""
        half_x, half_y = self.half_tan
        line = (2 * np.arange(SENT) + 1 - SENT) / FIELD
        return np.stack(np.meshgrid(line * half_x, -line * half_y), axis=-1).reshape(-1, 2)

    def in_field(self, field_tan: Array) -> NDArray[np.bool_]:
        """Return which directions (..., 2) lie in the field, which is the camera's picture."""
        return np.asarray(np.all(np.abs(field_tan) <= np.asarray(self.half_tan), axis=-1))

    def beam(self, slm_m: Array) -> Array:
        """Return the intensity of the beam at points of the panel (..., 2), (...), 1 in the middle."""
        return np.asarray(np.exp(-2 * np.sum((slm_m / self.waist_m) ** 2, axis=-1)))

    def envelope(self, sines: Array) -> Array:
        """Return what the area of the pixels leaves of the power that leaves along (..., 2) direction sines in S."""
        turned = sines / self.wavelength_m - np.asarray(self.panel.illumination_frequency_per_m)
        return np.asarray(np.prod(np.sinc(turned * self.active_m), axis=-1) ** 2)


def design_of(rig: SimulatedRig, wavelength_nm: float) -> Design:
    """Return the design of a simulated rig's file; its own misalignment is no part of it."""
    slm, optics, camera = rig.slm, rig.optics, rig.camera
    width = camera.field_deg * DEGREE
    height = 2 * float(np.arctan(np.tan(width / 2) * camera.height / camera.width))
    return Design(
        panel=Panel(slm.width, slm.height, slm.pitch_um * UM),
        pupil_diameter_m=(camera.pupil_mm or optics.pupil_mm) * MM,
        eye_relief_m=optics.eye_relief_mm * MM,
        wavelength_m=wavelength_nm * NM,
        field_rad=(width, height),
        camera_px=(camera.width, camera.height),
        waist_m=rig.illumination.waist_mm * MM if rig.illumination.profile == "gaussian" else np.inf,
        active_m=0.0 if slm.fill_factor is None else float(np.sqrt(slm.fill_factor)) * slm.pitch_um * UM,
    )


@dataclass(frozen=True)
class SentLight:
    """What the nominal hologram sends in D directions from N points of the panel.

    Parameters
    ----------
    field_tan
        (D, 2) directions.
    slm_m
        (N, 2) points of the panel.
    phase_rad
        (D, N) phase function there.
    direction
        (D, N, 3) unit directions in S that the light leaves along.
    pupil_m
        (D, N, 2) where it crosses the nominal pupil's plane, in P.
    sent
        (D, N) share of the amplitude that the footprint of the nominal pupil lets be sent.
    power
        (D, N) power that is sent towards the pupil, of a panel evenly shared out among the directions that each point
        serves; `assigned` is the same before the pixels' envelope takes its part. Square metres of evenly lit panel.
    shared_by
        (N,) number of directions of the field that share a point of the panel, at least 1.
    """

    field_tan: Array
    slm_m: Array
    phase_rad: Array
    direction: Array
    pupil_m: Array
    sent: Array
    power: Array
    assigned: Array
    shared_by: Array

    def some(self, directions: NDArray[np.intp]) -> SentLight:
        """Return the light of some of the directions."""
        return SentLight(
            self.field_tan[directions],
            self.slm_m,
            self.phase_rad[directions],
            self.direction[directions],
            self.pupil_m[directions],
            self.sent[directions],
            self.power[directions],
            self.assigned[directions],
            self.shared_by,
        )


@lru_cache(maxsize=2)
def sent_light(design: Design) -> SentLight:
    """Return the light that a hologram of the nominal bench sends; half a second, kept for the next bench."""
    bench, tangents, slm_m = design.bench, design.sent_directions(), panel_points(design.panel)
    points = VirtualPoints.at(tangents[:, None])
    there = exact_phase(bench, points, slm_m, wavelength_m=design.wavelength_m)
    found = there.error_m < LANDED_M
    pupil_m = np.where(found[..., None], there.pupil_m, 1.0)
    direction = -trace_points(bench, points, there.pupil_m).direction
    sent = np.where(found, transmission(pupil_m, design.pupil_diameter_m), 0.0)
    shared_by = np.maximum(np.sum(sent[design.in_field(tangents)] ** 2, axis=0), 1.0)
    cell_m2 = float(np.prod(design.panel.half_size_m)) * 4 / len(slm_m)
    assigned = sent**2 * design.beam(slm_m) / shared_by * cell_m2
    power = assigned * design.envelope(direction[..., :2])
    return SentLight(
        tangents, slm_m, np.nan_to_num(there.phase_rad), direction, pupil_m, sent, power, assigned, shared_by
    )


def panel_points(panel: Panel) -> Array:
    """Return an even grid of points of the panel, (N, 2) metres in S: rows from the bottom, columns from the left."""
    half = panel.half_size_m
    lines = [((np.arange(n) + 0.5) / n * 2 - 1) * h for n, h in zip(PANEL, half, strict=True)]
    return np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2)
