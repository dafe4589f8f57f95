"""The aberration's maps and the report's pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.field_model import field_terms
from holocal.loop.procedure import Figure
from procedures._aberration_light import array_of, dark_level, half_tan_of
from procedures._aberration_zones import Estimate

if TYPE_CHECKING:
    from procedures._aberration_model import State
    from procedures.aberration import Parameters

Array = NDArray[np.float64]
Extent = tuple[float, float, float, float]

TILE = 25  # camera pixels of a spot's picture
MAP_SIDE = 41  # of the correction's maps: a polynomial of degree 4 over the field


def extent_of(state: State) -> Extent:
    half = [float(np.degrees(angle) / 2) for angle in state.facts.camera.field_rad]
    return -half[0], half[0], -half[1], half[1]


def maps_of(state: State, valid: NDArray[np.bool_]) -> tuple[dict[str, NDArray[np.float32]], dict[str, str]]:
    """Return the correction over the field, a map per Noll index, row 0 on top, and how well it is known."""
    half = half_tan_of(state)
    at = (2 * np.arange(MAP_SIDE) + 1 - MAP_SIDE) / MAP_SIDE
    grid = np.stack(np.meshgrid(at * half[0], at[::-1] * half[1]), axis=-1).reshape(-1, 2)
    values = -field_terms(grid, half) @ state.coefficients_rad.T
    noll = state.parameters.noll
    maps = {
        f"correction.noll_{j}_rad": values[:, k].reshape(MAP_SIDE, MAP_SIDE).astype(np.float32)
        for k, j in enumerate(noll)
    }
    units = dict.fromkeys(maps, "rad")
    near = np.linalg.norm(grid[:, None] - array_of(state).field_tan[None], axis=-1).argmin(axis=1)
    maps["valid"] = valid[near].reshape(MAP_SIDE, MAP_SIDE).astype(np.float32)
    return maps, units | {"valid": "1"}


def mosaic_of(state: State, found: Estimate) -> NDArray[np.float32]:
    """Return the pictures of all zones in focus, side by side as they lie in the field, each to its own brightest."""
    frames = np.flatnonzero(state.defocus == 0)
    frame = int(frames[0]) if len(frames) else 0
    places = [None if window is None else (window.column, window.row) for window in found.windows]
    dark = dark_level(state, float(state.exposures_s[frame]))
    return mosaic(state.parameters.zones, places, state.pictures[frame], dark)


def mosaic(
    side: int, places: Sequence[tuple[int, int] | None], picture: NDArray[np.uint16], dark: float
) -> NDArray[np.float32]:
    """Return tiles round places (column, row) of a picture, `side` in a row, each to its own brightest pixel."""
    out = np.zeros((side * TILE, side * TILE), np.float32)
    half = TILE // 2
    for zone, place in enumerate(places):
        if place is None:
            continue
        at_column, at_row = place
        part = picture[
            max(at_row - half, 0) : max(at_row + half + 1, 0), max(at_column - half, 0) : max(at_column + half + 1, 0)
        ]
        row, column = divmod(zone, side)
        if part.shape == (TILE, TILE):
            tile = np.maximum(part.astype(np.float32) - np.float32(dark), 0)
            out[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE] = tile / max(float(tile.max()), 1.0)
    return out


def figures_of(
    parameters: Parameters,
    mosaics: tuple[NDArray[np.float32], NDArray[np.float32]],
    valid: NDArray[np.bool_],
    before: Mapping[str, Any],
    after: Mapping[str, Any],
    extent: Extent,
) -> tuple[Figure, ...]:
    """Return the report's pictures: the spots, the wavefront over the field, its error, the coefficients."""
    side, noll = parameters.zones, parameters.noll

    def over_field(values: list[Any]) -> Array:
        return np.array([np.nan if v is None else v for v in values], np.float64).reshape(side, side)

    def listed(numbers: Mapping[str, Any], key: str) -> Array:
        return np.array([numbers["zones"][zone][key][str(j)] for j in noll], np.float64)

    maps = {
        name: over_field([zone["wavefront_rms_rad"] for zone in numbers["zones"]])
        for name, numbers in (("before", before), ("after", after))
    }
    known = np.flatnonzero(valid)
    zone = int(known[np.argmax([before["zones"][z]["wavefront_rms_rad"] for z in known])]) if len(known) else 0
    where = before["zones"][zone]["field_deg"]
    return (
        Figure(
            "spots",
            "The spots in focus, before and after",
            "pair",
            {"before": mosaics[0], "after": mosaics[1]},
            "of each zone's brightest pixel",
            "One tile per zone, as they lie in the field; 25 x 25 camera pixels each. Empty: not lit, or not seen.",
        ),
        Figure(
            "field",
            "Wavefront of every zone (rms over its lit pupil)",
            "pair",
            {
                "before": maps["before"],
                "after": maps["after"],
                "valid": valid.reshape(side, side).astype(np.float32),
            },
            "rad",
            "Estimated from each side's own frames. Hatched: not measured; its correction is what the others predict.",
            extent,
        ),
        Figure(
            "coefficients",
            f"Zernike coefficients of the zone at {where[0]:.1f}, {where[1]:.1f} degrees, the worst before",
            "curve",
            {
                "x": np.array(noll, np.float64),
                "before": listed(before, "coefficients_rad"),
                "before_sigma": listed(before, "sigma_rad"),
                "after": listed(after, "coefficients_rad"),
            },
            "rad",
            "x: Noll index. The band is the standard error.",
        ),
    )
