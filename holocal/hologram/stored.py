"""Plans to arrays and back, so that they can be kept between programs: the traced phase functions of a bench.

The engine writes no files. It asks a `Store`, which the application keeps on disk, by a key that names everything a
plan depends on: bench, gaze, wavelength, field, depth, accuracy, correction, and the version of the method.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from holocal.hologram.settings import HologramSettings
from holocal.hologram.sight import Sight
from holocal.hologram.warp import Box, Depth, Warp
from holocal.hologram.warped import Layout, Patch, PatchForm, SightGrid, WarpedPlan, accurate_plan, warped_plan
from holocal.optics.bench import Array
from holocal.optics.series import Series

METHOD = 3  # raised whenever a plan of the same settings comes out different
Arrays = Mapping[str, Array]


class Store(Protocol):
    """Keeps arrays by name between programs; a damaged or absent entry is None."""

    def get(self, key: str) -> Arrays | None:
        """Return the arrays of a key, or None."""

    def put(self, key: str, arrays: Arrays) -> None:
        """Keep arrays; a store that cannot write keeps nothing and says nothing."""

    def __hash__(self) -> int:
        """Return the same for stores that keep the same."""


def stored_plan(
    settings: HologramSettings, depth: Depth, cut: tuple[int, int] | None, store: Store | None
) -> WarpedPlan:
    """Return a plan from the store, or make it and keep it. `cut` None: the coarsest cut that is accurate enough."""
    if store is None:
        return accurate_plan(settings) if cut is None else warped_plan(settings, depth, cut)
    key = plan_key(settings, depth, cut)
    arrays = store.get(key)
    if arrays is not None:
        return from_arrays(arrays)
    made = accurate_plan(settings) if cut is None else warped_plan(settings, depth, cut)
    store.put(key, to_arrays(made))
    return made


def plan_key(settings: HologramSettings, depth: Depth, cut: tuple[int, int] | None) -> str:
    """Return a name, 32 hexadecimal digits, for all that a plan depends on."""
    return hashlib.sha256(repr((METHOD, settings.of_plans(), depth, cut)).encode()).hexdigest()[:32]


def to_arrays(plan: WarpedPlan) -> dict[str, Array]:
    """Return a plan as named float64 arrays."""
    made = plan.layout
    out: dict[str, Array] = {
        "depth": np.array([plan.depth.inverse_m, float(plan.depth.flat)]),
        "cut": np.array(made.cut, float),
        "grid": np.array([made.grid.rows, made.grid.columns, *made.grid.first, *made.grid.step], float),
        "curvature": made.curvature,
        "pupil_of": made.sight.pupil_of,
        "sight": np.array([made.sight.pupil_radius_m, made.sight.wavenumber]),
        "patches": np.array([_patch_row(patch) for patch in made.patches]),
        "chosen": np.array([made.patches.index(form.patch) for form in plan.forms], float),
    }
    for name in ("to_sight", "to_panel", "reference_turns"):
        out |= _series_arrays(name, getattr(made.sight, name))
    for i, form in enumerate(plan.forms):
        out[f"seen {i}"] = form.seen
        out[f"error {i}"] = np.array([form.warp.square_rad2, form.warp.weight])
        for name in ("phase_rad", "coordinate", "field"):
            out |= _series_arrays(f"{name} {i}", getattr(form.warp, name))
    return out


def from_arrays(arrays: Arrays) -> WarpedPlan:
    """Return the plan of `to_arrays`."""
    radius, wavenumber = (float(v) for v in arrays["sight"])
    seen_as = Sight(
        _series("to_sight", arrays),
        _series("to_panel", arrays),
        _series("reference_turns", arrays),
        arrays["pupil_of"],
        radius,
        wavenumber,
    )
    rows, columns, x, y, step_x, step_y = (float(v) for v in arrays["grid"])
    grid = SightGrid(int(rows), int(columns), (x, y), (step_x, step_y))
    patches = tuple(_patch_of(row) for row in arrays["patches"])
    cut = (int(arrays["cut"][0]), int(arrays["cut"][1]))
    forms = []
    for i, chosen in enumerate(arrays["chosen"].astype(int)):
        square, weight = (float(v) for v in arrays[f"error {i}"])
        warp = Warp(
            _series(f"phase_rad {i}", arrays),
            _series(f"coordinate {i}", arrays),
            _series(f"field {i}", arrays),
            square,
            weight,
        )
        forms.append(PatchForm(patches[chosen], arrays[f"seen {i}"], warp))
    inverse, flat = arrays["depth"]
    layout = Layout(cut, seen_as, grid, patches, arrays["curvature"])
    return WarpedPlan(layout, Depth(float(inverse), bool(flat)), tuple(forms))


def _series_arrays(name: str, series: Series) -> dict[str, Array]:
    return {name: series.coefficients, f"{name} on": np.array([*series.centre, *series.half])}


def _series(name: str, arrays: Arrays) -> Series:
    x, y, half_x, half_y = (float(v) for v in arrays[f"{name} on"])
    return Series(arrays[name], (x, y), (half_x, half_y))


def _patch_row(patch: Patch) -> Array:
    ends = (patch.rows.start, patch.rows.stop, patch.columns.start, patch.columns.stop)
    return np.array([*ends, *patch.box.centre, *patch.box.half], float)


def _patch_of(row: Array) -> Patch:
    top, bottom, left, right = (int(v) for v in row[:4])
    return Patch(slice(top, bottom), slice(left, right), Box(row[4:6], row[6:8]))
