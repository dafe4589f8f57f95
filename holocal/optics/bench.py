"""The thesis's bench: an ellipsoid mirror whose foci are the eye's rotation centre and the panel's centre.

Frames (metres; docs/physics.md 1):

E  origin = rotation centre of the eye; +z = nominal gaze (eye to mirror), +y up, +x temporal (towards the panel).
S  origin = panel centre; z = from the panel to the nominal mirror point, y = y_E on the nominal bench, x = y x z.
P  origin = pupil centre, on the gaze direction at the eye relief; z = gaze, x = y_E x z normalised, y = z x x.

Arrays of pixels have row 0 on top (largest y) and column 0 at the smallest x.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from holocal.errors import ConfigError

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Panel:
    """A pixelated panel: `width` columns by `height` rows of square cells, `pitch_m` apart."""

    width: int
    height: int
    pitch_m: float

    def __post_init__(self) -> None:
        if not (self.width >= 1 and self.height >= 1 and 0 < self.pitch_m < np.inf):
            raise ConfigError(
                f"The panel is {self.width} x {self.height} pixels of {self.pitch_m * 1e6:g} um.",
                fix="Give at least one pixel each way and a pitch above 0.",
            )

    @property
    def x_m(self) -> Array:
        """Column centres, ascending, (width,) metres in S."""
        return np.asarray((np.arange(self.width) - (self.width - 1) / 2) * self.pitch_m, np.float64)

    @property
    def y_m(self) -> Array:
        """Row centres, descending, (height,) metres in S."""
        return np.asarray(((self.height - 1) / 2 - np.arange(self.height)) * self.pitch_m, np.float64)

    @property
    def half_size_m(self) -> tuple[float, float]:
        """Half of the panel's width and height, outer edges included."""
        return self.width * self.pitch_m / 2, self.height * self.pitch_m / 2

    @property
    def illumination_frequency_per_m(self) -> tuple[float, float]:
        """Spatial frequency of the illumination on the panel, cycles per metre along (x, y) of S.

        The collimated beam is tilted by half an order spacing in +y, for every wavelength: the zero order comes to a
        focus above the pupil, the signal sits midway between orders 0 and 1 (thesis 3.1).
        """
        return 0.0, 0.5 / self.pitch_m


@dataclass(frozen=True)
class Pose:
    """A rigid displacement: rotations about x, then y, then z of fixed axes (radians), then a shift (metres)."""

    rotation_rad: Vector = (0.0, 0.0, 0.0)
    shift_m: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not np.all(np.isfinite([*self.rotation_rad, *self.shift_m])):
            raise ConfigError(f"A displacement is not finite: {self.rotation_rad} rad, {self.shift_m} m.")

    @cached_property
    def matrix(self) -> Array:
        """Rotation matrix Rz Ry Rx, (3, 3): about x it takes +y towards +z, about y +z to +x, about z +x to +y."""
        (cx, cy, cz), (sx, sy, sz) = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return np.asarray(about_z @ about_y @ about_x)


@dataclass(frozen=True)
class Bench:
    """The ellipsoid bench (thesis 2.2 and 4.1), nominal or misaligned.

    Parameters
    ----------
    semi_major_m, semi_minor_m
        Semi-axes of the ellipsoid of revolution.
    eye_to_mirror_m
        Distance from the eye's rotation centre to the nominal mirror point, on +z of E.
    pupil_diameter_m, eye_relief_m
        The pupil, and its distance in front of the eye's rotation centre.
    mirror
        Displacement of the mirror: rotation about the nominal mirror point along the axes of E, then a shift in E.
    slm
        Displacement of the panel: rotation about its own centre along the nominal axes of S, then a shift in S.
    """

    semi_major_m: float = 125e-3
    semi_minor_m: float = 86.96e-3
    eye_to_mirror_m: float = 50e-3
    pupil_diameter_m: float = 3e-3
    eye_relief_m: float = 12e-3
    mirror: Pose = field(default_factory=Pose)
    slm: Pose = field(default_factory=Pose)

    def __post_init__(self) -> None:
        a, b, t = self.semi_major_m, self.semi_minor_m, self.eye_to_mirror_m
        if not (0 < b < a < np.inf):
            raise ConfigError(
                f"The ellipsoid's semi-axes are {a * 1e3:g} and {b * 1e3:g} mm; the first must be the larger.",
                fix="Give semi_major_m > semi_minor_m > 0.",
            )
        focus = np.sqrt(a * a - b * b)
        if not (a - focus < t < a + focus):
            raise ConfigError(
                f"The eye is {t * 1e3:g} mm from the mirror; a focus is between "
                f"{(a - focus) * 1e3:.2f} and {(a + focus) * 1e3:.2f} mm from every point of this ellipsoid.",
                fix="Change eye_to_mirror_m.",
            )
        if not 0 < self.eye_relief_m < t:
            raise ConfigError(
                f"The pupil is {self.eye_relief_m * 1e3:g} mm in front of the eye's rotation centre.",
                why="It must be between the centre, where the panel's image is, and the mirror.",
                fix=f"Give eye_relief_m between 0 and {t:g}.",
                measured=self.eye_relief_m,
                limit=t,
            )
        if not 0 < self.pupil_diameter_m < 2 * b:
            raise ConfigError(
                f"The pupil's diameter is {self.pupil_diameter_m * 1e3:g} mm.",
                fix=f"Give pupil_diameter_m above 0 and below the mirror's {2 * b:g}.",
                measured=self.pupil_diameter_m,
                limit=2 * b,
            )

    @classmethod
    def nominal(cls, *, pupil_diameter_m: float = 3e-3, eye_relief_m: float = 12e-3) -> Bench:
        """Return the thesis's bench with nothing misaligned."""
        return cls(pupil_diameter_m=pupil_diameter_m, eye_relief_m=eye_relief_m)

    def aligned(self) -> Bench:
        """Return the same bench without its misalignment."""
        return replace(self, mirror=Pose(), slm=Pose())

    @property
    def mirror_to_slm_m(self) -> float:
        """Distance from the nominal mirror point to the panel's centre: both arms together are 2 a."""
        return 2 * self.semi_major_m - self.eye_to_mirror_m

    @property
    def magnification(self) -> float:
        """Nominal demagnification M of the panel at the eye's rotation centre."""
        return self.mirror_to_slm_m / self.eye_to_mirror_m

    @cached_property
    def mirror_point(self) -> Array:
        """Nominal mirror point in E, (3,)."""
        return np.array([0.0, 0.0, self.eye_to_mirror_m])

    @cached_property
    def nominal_slm_centre(self) -> Array:
        """Panel centre of the aligned bench in E, (3,): the far focus."""
        t, s = self.eye_to_mirror_m, self.mirror_to_slm_m
        between_foci_sq = 4 * (self.semi_major_m**2 - self.semi_minor_m**2)
        cos_arms = (t * t + s * s - between_foci_sq) / (2 * t * s)
        return self.mirror_point + s * np.array([np.sqrt(1 - cos_arms**2), 0.0, -cos_arms])

    @cached_property
    def nominal_slm_axes(self) -> Array:
        """Columns x, y, z of the aligned S frame in E, (3, 3)."""
        z = (self.mirror_point - self.nominal_slm_centre) / self.mirror_to_slm_m
        y = np.array([0.0, 1.0, 0.0])
        return np.stack([np.cross(y, z), y, z], axis=1)

    @cached_property
    def slm_centre(self) -> Array:
        """Panel centre in E, (3,)."""
        return np.asarray(self.nominal_slm_centre + self.nominal_slm_axes @ np.asarray(self.slm.shift_m))

    @cached_property
    def slm_axes(self) -> Array:
        """Columns x, y, z of S in E, (3, 3)."""
        return np.asarray(self.nominal_slm_axes @ self.slm.matrix)

    @cached_property
    def mirror_centre(self) -> Array:
        """Centre of the ellipsoid in E, (3,)."""
        arm = self.nominal_slm_centre / 2 - self.mirror_point
        return np.asarray(self.mirror_point + self.mirror.matrix @ arm + np.asarray(self.mirror.shift_m))

    @cached_property
    def mirror_quadric(self) -> Array:
        """Symmetric Q, (3, 3) per square metre: the mirror is (r - centre)^T Q (r - centre) = 1."""
        axis = self.mirror.matrix @ (self.nominal_slm_centre / np.linalg.norm(self.nominal_slm_centre))
        along, across = 1 / self.semi_major_m**2, 1 / self.semi_minor_m**2
        return np.eye(3) * across + (along - across) * np.outer(axis, axis)

    def pupil_axes(self, gaze_rad: tuple[float, float] = (0.0, 0.0)) -> Array:
        """Return the columns x, y, z of P in E, (3, 3), for a gaze whose tangents are tan(gaze_rad)."""
        z = np.array([np.tan(gaze_rad[0]), np.tan(gaze_rad[1]), 1.0])
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z], axis=1)

    def pupil_points(self, pupil_m: Array, gaze_rad: tuple[float, float] = (0.0, 0.0)) -> Array:
        """Return points of the pupil plane, (..., 2) metres in P, as points of E, (..., 3)."""
        axes = self.pupil_axes(gaze_rad)
        return axes[:, 2] * self.eye_relief_m + np.asarray(pupil_m) @ axes[:, :2].T


def field_directions(field_tan: Array, axes: Array | None = None) -> Array:
    """Return unit directions in E, (..., 3), of field points given by their tangents (tan x, tan y), (..., 2).

    The field is rectilinear: a direction is (tan x, tan y, 1) normalised, in P (`axes`, default those of E).
    """
    tangents = np.asarray(field_tan, dtype=np.float64)
    local = np.concatenate([tangents, np.ones((*tangents.shape[:-1], 1))], axis=-1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return local if axes is None else local @ axes.T


def image_tangents(columns: int, rows: int, field_rad: tuple[float, float]) -> tuple[Array, Array]:
    """Return (columns,) ascending x and (rows,) descending y tangents of the pixel centres of a rectilinear image.

    The image's outer edges are at +-tan(field_rad / 2).
    """
    half_x, half_y = np.tan(field_rad[0] / 2), np.tan(field_rad[1] / 2)
    x = (2 * np.arange(columns) + 1 - columns) / columns * half_x
    y = (rows - 1 - 2 * np.arange(rows)) / rows * half_y
    return x, y
