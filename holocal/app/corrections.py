"""Accepted corrections, each where it belongs: points, wavefront, levels.

| procedure | channels of its maps | acts on |
|---|---|---|
| uniformity | ``correction.intensity_weight`` | a point's intensity |
| distortion | ``correction.shift_tan_x``, ``correction.shift_tan_y`` | a point's direction, added to its tangents |
| aberration | ``correction.noll_<j>_rad`` at ``wavelength_nm`` | the points' phase functions |
| response | ``correction.phase_rad``, a column per level, at ``wavelength_nm`` | the levels, within 2 nm of that line |
| alignment | the maps' metadata ``bench.<displacement>`` | the bench that holograms are made for |

The bench that `alignment` found explains distortion and aberration both: these are left out while it is in force.

Maps are rectilinear over their ``extent_deg``, row 0 on top, of directions seen from the eye, not from the gaze.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from holocal.estimate.bench_pose import DISPLACEMENTS, bench_at
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.wavefront import Wavefront, field_basis
from holocal.optics.bench import Array, Bench
from holocal.records.calibration import Accepted
from holocal.records.field_map import FieldMap, field_map, missing
from holocal.records.response import PHASE, RESPONSE, PhaseResponse, response_of
from holocal.units import NM

__all__ = ["PHASE", "RESPONSE", "Corrections", "FieldMap", "corrections_of"]

UNIFORMITY, DISTORTION, ABERRATION, ALIGNMENT = "uniformity", "distortion", "aberration", "alignment"
WEIGHT = "correction.intensity_weight"
SHIFTS = ("correction.shift_tan_x", "correction.shift_tan_y")
NOLL = re.compile(r"correction\.noll_(\d+)_rad")
_FIELD_DEGREE = 5  # of a Zernike coefficient over the field; the residual of the fit is its own check


@dataclass(frozen=True)
class Corrections:
    """What the accepted calibration does to a scene.

    `weight` and `shift` map directions; `wavefront`, `response` and `displacements` (12,) are for the engine;
    `identities` names the corrections in force that change nothing and are left out, `superseded` those that the bench
    found by `alignment` stands in for.
    """

    weight: FieldMap | None = None
    shift: tuple[FieldMap, FieldMap] | None = None
    wavefront: Wavefront | None = None
    response: PhaseResponse | None = None
    displacements: Array | None = None
    identities: tuple[str, ...] = ()
    superseded: tuple[str, ...] = ()

    def bench(self, nominal: Bench) -> Bench:
        """Return the bench that holograms are made for: the one that `alignment` found, or the one drawn."""
        return nominal if self.displacements is None else bench_at(nominal, self.displacements)

    def skipped(self, wavelength_nm: float) -> list[str]:
        """Return a sentence for each correction in force that a frame of this line goes without."""
        said = [f"the accepted {name}: it changes nothing" for name in self.identities]
        said += [f"the accepted {name}: the accepted bench (alignment) explains it" for name in self.superseded]
        left_out = self.response.left_out(wavelength_nm) if self.response else ""
        return [*said, left_out] if left_out else said

    def response_rad(self, wavelength_nm: float, bits: int) -> Array | None:
        """Return the phase of each level of a panel at a line; None stands for 2 pi L / 256."""
        measured = self.response.at(wavelength_nm) if self.response else None
        if measured is None and bits < 8:
            return np.asarray(np.arange(2**bits) * (2 * np.pi / 2**bits))
        return measured

    def apply(self, cloud: PointCloud, gaze_rad: tuple[float, float]) -> PointCloud:
        """Return a cloud with corrected directions and brightness; the tangents of a cloud are relative to the gaze."""
        if self.shift is None and self.weight is None:
            return cloud
        axes = Bench.nominal().pupil_axes(gaze_rad)
        seen = _turned(cloud.field_tan, axes)
        if self.shift is not None:
            seen = seen + np.stack([one.at(seen) for one in self.shift], axis=-1)
            cloud = replace(cloud, field_tan=_turned(seen, axes.T))
        if self.weight is not None:
            cloud = replace(cloud, amplitude=cloud.amplitude * np.sqrt(np.maximum(self.weight.at(seen), 0.0)))
        return cloud


def _turned(field_tan: Array, axes: Array) -> Array:
    """Return the tangents (n, 2) in E of directions with tangents in a frame of these axes (3, 3)."""
    turned = np.concatenate([field_tan, np.ones((len(field_tan), 1))], axis=1) @ axes.T
    return np.asarray(turned[:, :2] / turned[:, 2:])


def corrections_of(accepted: Mapping[str, Accepted], *, fov_rad: tuple[float, float]) -> Corrections:
    """Return the corrections of accepted runs; those that change nothing are named and left out.

    Raises
    ------
    InputError
        An accepted run has not the channels that its procedure promises.
    """
    found, identities = Corrections(), []
    if one := accepted.get(ALIGNMENT):
        superseded = tuple(name for name in (DISTORTION, ABERRATION) if name in accepted)
        accepted = {name: other for name, other in accepted.items() if name not in superseded}
        found = replace(found, displacements=_displacements(one), superseded=superseded)
    if one := accepted.get(UNIFORMITY):
        weight = field_map(one, WEIGHT)
        identities += _kept_out(UNIFORMITY, bool(np.all(weight.values == 1)))
        found = replace(found, weight=None if UNIFORMITY in identities else weight)
    if one := accepted.get(DISTORTION):
        shift = (field_map(one, SHIFTS[0]), field_map(one, SHIFTS[1]))
        identities += _kept_out(DISTORTION, not (shift[0].values.any() or shift[1].values.any()))
        found = replace(found, shift=None if DISTORTION in identities else shift)
    if one := accepted.get(ABERRATION):
        wavefront = _wavefront(one, fov_rad)
        identities += _kept_out(ABERRATION, wavefront.is_identity())
        found = replace(found, wavefront=None if ABERRATION in identities else wavefront)
    if one := accepted.get(RESPONSE):
        response = response_of(one)
        identities += _kept_out(RESPONSE, response.is_identity())
        found = replace(found, response=None if RESPONSE in identities else response)
    return replace(found, identities=tuple(identities))


def _displacements(accepted: Accepted) -> Array:
    values = [accepted.maps.metadata.get(f"bench.{name}") for name in DISPLACEMENTS]
    if any(value is None for value in values):
        raise missing(accepted, "the displacements of its bench (metadata bench.*)")
    return np.array([float(str(value)) for value in values])


def _kept_out(name: str, identity: bool) -> list[str]:
    return [name] if identity else []


def _wavefront(accepted: Accepted, fov_rad: tuple[float, float]) -> Wavefront:
    """Return the accepted Zernike maps as polynomials over the field, fitted to their pixels inside it."""
    names = {int(match[1]): name for name in accepted.maps.channels if (match := NOLL.fullmatch(name))}
    wavelength = accepted.maps.metadata.get("wavelength_nm")
    if not names or not isinstance(wavelength, (int, float)):
        raise missing(accepted, "channels correction.noll_<j>_rad and a wavelength_nm")
    maps = {j: field_map(accepted, names[j]) for j in sorted(names)}
    half = (float(np.tan(fov_rad[0] / 2)), float(np.tan(fov_rad[1] / 2)))
    line = 0.96 * np.linspace(-1, 1, 4 * _FIELD_DEGREE + 1)  # inside the centres of the border pixels of most maps
    nodes = np.stack(np.meshgrid(line * half[0], line * half[1]), axis=-1).reshape(-1, 2)
    inverse = np.linalg.pinv(field_basis(nodes, half, _FIELD_DEGREE))
    rows = tuple(tuple(float(c) for c in inverse @ one.at(nodes)) for one in maps.values())
    return Wavefront(tuple(maps), rows, half, _FIELD_DEGREE, float(wavelength) * NM)
