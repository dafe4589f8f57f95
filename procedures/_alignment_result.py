"""The alignment's result: displacements with their errors, screws to turn, the prediction and how it was verified."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.bench_pose import DISPLACEMENTS
from holocal.estimate.camera_lens import ideal_pixels, ideal_tangents, pixel_tan
from holocal.estimate.ray_wavefront import NOLL
from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Figure
from procedures._alignment_fit import prior_of, verified, zone_light
from procedures._alignment_posterior import PosePosterior, posterior_of
from procedures._alignment_screws import Effects, directions_of, effects_of, moves_of, screws_of
from procedures._bench_light import NUISANCE
from procedures._distortion_map import measured, spots_seen
from procedures._distortion_points import dark_subtracted

if TYPE_CHECKING:
    from procedures.alignment import State

Array = NDArray[np.float64]
Maps = dict[str, NDArray[np.float32]]

GRID = 60  # of the exported maps of the prediction, each way
POSES = slice(len(NUISANCE), None)


def conclusion(state: State, frames: Sequence[Frame]) -> Conclusion:
    """Return the result from the spots' frames and the verification's."""
    chosen, camera, prior = state.parameters, state.facts.camera, prior_of(state)
    chain = posterior_of(state, spots_seen(state.spots), prior)
    effects = effects_of(state)
    sigma = np.sqrt(np.diag(chain.covariance))
    array, places = verified(state, frames)
    wanted = ideal_pixels(array.field_tan, camera)
    sent, seen = measured(state.spots)
    predicted = _zones_rad(effects, chain.across[POSES, POSES])
    before = _side(
        np.zeros(len(DISPLACEMENTS)), prior[POSES], float(np.nanmedian(effects.at_fit.wavefront.rms_rad[effects.lit])),
        (seen.ideal_px - sent)[seen.found], len(sent),
    )  # fmt: skip
    after = _side(
        state.values[POSES], sigma, float(np.median(predicted)), (places.ideal_px - wanted)[places.found],
        int(array.on.sum()),
    )  # fmt: skip
    met = after["predicted_residual_rms_rad"] <= chosen.target_rad and after["position_rms_px"] <= chosen.target_px
    met = met and after["points_found"] >= 0.7 * after["points_expected"]
    moves, directions = moves_of(state, effects), directions_of(state, prior)
    half = np.degrees(np.asarray(camera.field_rad) / 2)
    extent = (-float(half[0]), float(half[0]), -float(half[1]), float(half[1]))
    maps, units = _maps(state, effects)
    pictures = [
        np.asarray(dark_subtracted(counts, state.spots.reference, float(exposure_s)), np.float32)
        for counts, exposure_s in (
            (state.spots.pictures[0], state.spots.exposures_s[0]),
            (frames[0].counts, frames[0].exposure_s),
        )
    ]
    return Conclusion(
        before=before,
        after=after,
        targets={"predicted_residual_rms_rad": chosen.target_rad, "position_rms_px": chosen.target_px},
        targets_met=bool(met),
        sentence=_sentence(before, after, moves, directions, met=bool(met), state=state),
        maps=maps,
        before_map=pictures[0],
        after_map=pictures[1],
        map_units=units | {"before": "counts", "after": "counts"},
        map_metadata={f"bench.{name}": float(v) for name, v in zip(DISPLACEMENTS, state.values[POSES], strict=True)},
        extent_deg=extent,
        extra={
            "screws": (screws := screws_of(state, effects, sigma)),
            "tables": [_table(screws, moves)],
            "moves": moves,
            "directions": directions,
            "undetermined": [one["direction"] for one in directions if not one["determined"]],
            "covariance": chain.covariance.tolist(),
            "posterior": chain.said,
            "nuisance": dict(zip(NUISANCE, state.values[: len(NUISANCE)].tolist(), strict=True)),
            "residual_standard_errors": float(np.sqrt(np.nanmean(state.residual**2))),
            "verified_nm": state.verify_nm,
            "checked_tan": array.field_tan[places.found].tolist(),
            "rig_facts": {
                "panel_width": state.facts.slm.width,
                "panel_height": state.facts.slm.height,
                "pitch_m": state.facts.slm.pitch_m,
                "pupil_diameter_m": state.facts.pupil_diameter_m,
                "eye_relief_m": state.facts.eye_relief_m,
                "pixel_tan": pixel_tan(camera),
                "field_rad": list(camera.field_rad),
                "wavelength_nm": chosen.wavelength_nm,
            },
        },
        figures=_figures(
            pictures,
            chain,
            state,
            _arrows(sent, seen.ideal_px - sent, seen.found, state),
            _arrows(wanted, places.ideal_px - wanted, places.found, state),
            maps,
            extent,
        ),
    )


def _side(means: Array, sigmas: Array, rad: float, off_px: Array, expected: int) -> dict[str, Any]:
    """Return `before` or `after`."""
    distance = np.linalg.norm(off_px, axis=1)
    side: dict[str, Any] = {
        name: {"mean": float(mean), "sigma": float(sigma)}
        for name, mean, sigma in zip(DISPLACEMENTS, means, sigmas, strict=True)
    }
    return side | {
        "predicted_residual_rms_rad": rad,
        "position_rms_px": float(np.sqrt(np.mean(distance**2))) if len(distance) else float("inf"),
        "position_max_px": float(distance.max()) if len(distance) else float("inf"),
        "points_found": len(distance),
        "points_expected": expected,
    }


def _sentence(
    before: dict[str, Any],
    after: dict[str, Any],
    moves: dict[str, Any],
    directions: list[dict[str, Any]],
    *,
    met: bool,
    state: State,
) -> str:
    turned = ", ".join(f"{name} by {by:+.3f}" for name, by in moves["moves"].items()) or "no screw"
    unknown = sum(not one["determined"] for one in directions)
    return (
        f"the bench found predicts wavefronts to {after['predicted_residual_rms_rad']:.3f} rad (the drawn one: "
        f"{before['predicted_residual_rms_rad']:.2f}; target {state.parameters.target_rad:g}) and positions at "
        f"{state.verify_nm:g} nm to {after['position_rms_px']:.3f} px (target {state.parameters.target_px:g}): "
        f"{'met' if met else 'not met'}; turn {turned} to leave {moves['leaves_px']:.1f} px and "
        f"{moves['leaves_rad']:.2f} rad; {unknown} of {len(directions)} combinations cannot be told"
    )


def _table(screws: list[dict[str, Any]], moves: dict[str, Any]) -> dict[str, Any]:
    """Return the table of screws for the report."""
    enough = "brings the bench" if moves["within_tolerance"] else "does not bring the bench"
    return {
        "title": "Screws",
        "columns": ["screw", "stands at", "standard error", "shifts the picture, px", "wavefront, rad", "turn by"],
        "rows": [
            [
                line["screw"].replace("_", " "), line["value"], line["sigma"], line["causes_px"], line["causes_rad"],
                moves["moves"].get(line["screw"], ""),
            ]
            for line in screws
        ],
        "caption": f"Rotations in degrees, shifts in mm; what each does alone, rms over the field. Turning the marked "
        f"{enough} within {moves['tolerance_px']:g} px and {moves['tolerance_rad']:g} rad: "
        f"{moves['leaves_px']:.2g} px and {moves['leaves_rad']:.2g} rad are left.",
    }  # fmt: skip


def _zones_rad(effects: Effects, covariance: Array) -> Array:
    """Return the rms over the posterior of every lit zone's wavefront off its mean, radians."""
    strength, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(strength, 0.0))
    each = (effects.wavefront_rad @ root).reshape(effects.zones, len(NOLL), -1)
    return np.asarray(np.sqrt(np.sum(each**2, axis=(1, 2))))


def _maps(state: State, effects: Effects) -> tuple[Maps, dict[str, str]]:
    """Return what the bench that was found makes of the drawn one's pictures, over the camera's field."""
    from scipy.interpolate import griddata

    camera = state.facts.camera
    columns = (np.arange(GRID) + 0.5) / GRID * camera.width - 0.5
    rows = (np.arange(GRID) + 0.5) / GRID * camera.height - 0.5
    at = ideal_tangents(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2), camera)
    known = ideal_tangents(ideal_pixels(zone_light(state).array.field_tan, camera), camera)[effects.lit]
    values = np.column_stack([effects.at_fit.off_px, effects.at_fit.wavefront.rms_rad])[effects.lit]
    found = griddata(known, values, at, method="cubic")
    valid = np.isfinite(found).all(axis=1)
    channels = [*np.nan_to_num(found).T, valid.astype(np.float64)]
    names = ("predicted.off_px_x", "predicted.off_px_y", "predicted.wavefront_rms_rad", "valid")
    units = dict(zip(names, ("px", "px", "rad", "1"), strict=True))
    return {name: one.reshape(GRID, GRID).astype(np.float32) for name, one in zip(names, channels, strict=True)}, units


def _arrows(wanted_px: Array, off_px: Array, found: NDArray[np.bool_], state: State) -> NDArray[np.float32]:
    degrees = np.degrees(np.arctan(ideal_tangents(wanted_px[found], state.facts.camera)))
    return np.column_stack([degrees, off_px[found] * [1, -1]]).astype(np.float32)


def _figures(
    pictures: list[NDArray[np.float32]],
    chain: PosePosterior,
    state: State,
    before: NDArray[np.float32],
    after: NDArray[np.float32],
    maps: Maps,
    extent: tuple[float, float, float, float],
) -> tuple[Figure, ...]:
    tops = [max(float(np.quantile(one, 0.9995)), 1.0) for one in pictures]
    shown = [np.clip(one / top, 0, 1).astype(np.float32) for one, top in zip(pictures, tops, strict=True)]
    labels = tuple(name.replace("_", " ") for name in DISPLACEMENTS)
    return (
        Figure(
            "spots", "The spots of the drawn bench's hologram, and of that of the bench found", "pair",
            {"before": shown[0], "after": shown[1]}, "of the brightest",
            f"The camera's pictures; after: the verification's, at {state.verify_nm:g} nm.",
        ),
        Figure(
            "arrows", "From where spots should be to where they are seen", "vectors",
            {"before": before, "after": after}, "px",
            "Each panel has a scale of its own. Before: the drawn bench's holograms. After: the verification's, "
            "made for the bench that was found.", extent,
        ),
        Figure(
            "wavefront", "Wavefront that the drawn bench's holograms leave", "map",
            {"values": maps["predicted.wavefront_rms_rad"], "valid": maps["valid"]}, "rad",
            "Predicted by rays over the bench that was found; rms over the pupil.", extent,
        ),
        Figure(
            "posterior", "The twelve displacements", "corner",
            {
                "samples": chain.samples, "laplace_mean": state.values[POSES],
                "laplace_covariance": state.covariance[POSES, POSES],
            },
            "degrees and mm",
            f"Sampled by emcee, beam and camera left out; lines: Laplace. {chain.said['acceptance']:.0%} of the "
            "proposals were taken. The mirror's turn about its own axis changes no picture: it is its prior's.",
            labels=labels,
        ),
    )  # fmt: skip
