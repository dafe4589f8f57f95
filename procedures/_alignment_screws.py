"""What a technician is told: which displacements there are, which cannot be told apart, and which screws to turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.bench_pose import DISPLACEMENTS, bench_at
from procedures._aberration_spots import nominal_bench
from procedures._alignment_fit import Seen, seen_by, zone_light
from procedures._bench_light import BEAM, NUISANCE

if TYPE_CHECKING:
    from procedures.alignment import Parameters, State

Array = NDArray[np.float64]

TOLD_APART = 0.7  # of the prior's standard deviation that is left: above it the data say nothing of a direction
NAMED = 0.2  # of a direction's unit length: what is less is left out of its name
MOST_MOVES = 6
TRACED = 3  # times that moves are made better by rays
STEP = 0.02  # degrees and mm, of the derivatives


@dataclass(frozen=True)
class Effects:
    """What displacements do to the picture, linear, over the n zones that are `lit`.

    `position_px` (2 n, 12) and `wavefront_rad` (n modes, 12) are per degree and mm; `root` (n, modes, modes) makes of a
    zone's coefficients a vector as long as its rms. `at_fit` and `nominal` are what the bench found and the aligned one
    give.
    """

    position_px: Array
    wavefront_rad: Array
    root: Array
    at_fit: Seen
    nominal: Seen
    lit: NDArray[np.bool_]

    @property
    def zones(self) -> int:
        """How many zones are lit."""
        return int(np.count_nonzero(self.lit))

    def errors(self, values: Array) -> tuple[float, float]:
        """Return the picture's shift (px) and its wavefront (rad) for displacements (12,), rms over the zones."""
        return _rms(self.position_px @ values, self.zones), _rms(self.wavefront_rad @ values, self.zones)


def effects_of(state: State) -> Effects:
    """Return the effects of every displacement, differences halfway between the drawn bench and the one found."""
    light, beam, values = zone_light(state), state.values[: len(BEAM)], state.values[len(NUISANCE) :]

    def seen(pose: Array) -> Seen:
        return seen_by(light, bench_at(nominal_bench(state.facts), pose), beam)

    found, nominal = seen(values), seen(np.zeros(len(DISPLACEMENTS)))
    pairs = [(seen(values / 2 + STEP * e), seen(values / 2 - STEP * e)) for e in np.eye(len(DISPLACEMENTS))]
    lit = light.array.on.copy()
    for one in (found, nominal, *(side for pair in pairs for side in pair)):
        lit &= np.isfinite(one.off_px[:, 0]) & np.isfinite(one.wavefront.rms_rad)
    root = _roots(found.wavefront.metric[lit])
    by_place = [(a.off_px - b.off_px)[lit].ravel() / (2 * STEP) for a, b in pairs]
    by_wave = [
        _over_the_light(root, (a.wavefront.coefficients_rad - b.wavefront.coefficients_rad)[lit]) / (2 * STEP)
        for a, b in pairs
    ]
    return Effects(np.stack(by_place, axis=1), np.stack(by_wave, axis=1), root, found, nominal, lit)


def _roots(metric: Array) -> Array:
    """Return R (zones, modes, modes) with R^T R = metric: the length of R c is the rms over the light."""
    strength, axes = np.linalg.eigh(metric)
    return np.asarray(np.sqrt(np.maximum(strength, 0.0))[:, :, None] * axes.transpose(0, 2, 1))


def _over_the_light(root: Array, coefficients_rad: Array) -> Array:
    return np.asarray(np.einsum("zij,zj->zi", root, coefficients_rad).ravel())


def directions_of(state: State, prior: Array) -> list[dict[str, Any]]:
    """Return the combinations of displacements that the data tell, the best first: direction, value, sigma.

    They are the eigenvectors of the information on the displacements (the beam marginalised), in units of the prior's
    standard deviations. One that the data leave as wide as the prior is `determined: false`: a rotation of the mirror
    about the axis through its foci, for one, changes nothing at all.
    """
    beams, poses = slice(None, len(NUISANCE)), slice(len(NUISANCE), None)
    information = state.information
    inner = information[beams, beams] + np.diag(prior[beams] ** -2.0)
    told = information[poses, poses] - information[poses, beams] @ np.linalg.solve(inner, information[beams, poses])
    unit = prior[poses]
    strength, vectors = np.linalg.eigh(unit[:, None] * told * unit)
    found = []
    for size, vector in zip(strength[::-1], vectors.T[::-1], strict=True):
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        row = vector / unit
        sigma = float(np.sqrt(row @ state.covariance[poses, poses] @ row))
        found.append(
            {
                "direction": {name: float(v) for name, v in zip(DISPLACEMENTS, vector, strict=True) if abs(v) > NAMED},
                "vector": row.tolist(),
                "value": float(row @ state.values[poses]),
                "sigma": sigma,
                "determined": bool(1 / np.sqrt(1 + max(float(size), 0.0)) < TOLD_APART),
            }
        )
    return found


def screws_of(state: State, effects: Effects, sigma: Array) -> list[dict[str, Any]]:
    """Return a line per displacement: value, sigma, and the error of the picture that it causes alone."""
    lines = []
    for k, name in enumerate(DISPLACEMENTS):
        alone = np.zeros(len(DISPLACEMENTS))
        alone[k] = state.values[len(NUISANCE) + k]
        px, rad = effects.errors(alone)
        lines.append(
            {"screw": name, "value": float(alone[k]), "sigma": float(sigma[k]), "causes_px": px, "causes_rad": rad}
        )
    return lines


def moves_of(state: State, effects: Effects) -> dict[str, Any]:
    """Return the fewest screws that bring the bench within tolerance, and by how much to turn each.

    Of all sets of as few screws the one that leaves least, by the linear effects; its moves are then made better, and
    judged, by rays.
    """
    chosen, values = state.parameters, state.values[len(NUISANCE) :]
    scale = np.sqrt(effects.zones) * np.array([chosen.tolerance_px, chosen.tolerance_rad])
    rows = np.concatenate([effects.position_px / scale[0], effects.wavefront_rad / scale[1]])
    gram, right = rows.T @ rows, rows.T @ (rows @ values)
    best: tuple[tuple[int, ...], Array, tuple[float, float]] | None = None
    for count in range(MOST_MOVES + 1):
        _, screws, by = min((_moved(gram, right, one) for one in combinations(range(len(values)), count)), key=_left)
        for _ in range(TRACED if count else 1):
            position, wavefront = _traced(state, effects, screws, by)
            left = _rms(position, effects.zones), _rms(wavefront, effects.zones)
            off = _off(left, chosen)
            if best is None or off < _off(best[2], chosen):
                best = (screws, by, left)
            if off <= 1 or not count:
                break
            error = np.concatenate([position / scale[0], wavefront / scale[1]])
            by = by - np.linalg.lstsq(rows[:, list(screws)], error, rcond=1e-9)[0]
        if best is not None and _off(best[2], chosen) <= 1:
            break
    assert best is not None
    return {
        "tolerance_px": chosen.tolerance_px,
        "tolerance_rad": chosen.tolerance_rad,
        "moves": {DISPLACEMENTS[k]: float(by) for k, by in zip(best[0], best[1], strict=True)},
        "leaves_px": best[2][0],
        "leaves_rad": best[2][1],
        "within_tolerance": bool(_off(best[2], chosen) <= 1),
    }


def _off(left: tuple[float, float], chosen: Parameters) -> float:
    """Return by how much what is left exceeds the tolerances: 1 is just within."""
    return max(left[0] / chosen.tolerance_px, left[1] / chosen.tolerance_rad)


def _moved(gram: Array, right: Array, screws: tuple[int, ...]) -> tuple[float, tuple[int, ...], Array]:
    """Return what moves of some screws take off the squared error, negative; the screws; the moves."""
    if not screws:
        return 0.0, screws, np.zeros(0)
    index = np.array(screws)
    own = gram[np.ix_(index, index)]
    by = -np.linalg.solve(own + 1e-9 * np.trace(own) * np.eye(len(index)), right[index])
    return float(by @ own @ by + 2 * by @ right[index]), screws, by


def _left(moved: tuple[float, tuple[int, ...], Array]) -> float:
    return moved[0]


def _traced(state: State, effects: Effects, screws: Sequence[int], by: Array) -> tuple[Array, Array]:
    """Return the picture's shifts (2 n,) and wavefronts (n modes,) after moves, by rays; a zone gone dark leaves 0."""
    values = state.values[len(NUISANCE) :].copy()
    values[list(screws)] += by
    seen = seen_by(zone_light(state), bench_at(nominal_bench(state.facts), values), state.values[: len(BEAM)])
    wavefront = _over_the_light(effects.root, seen.wavefront.coefficients_rad[effects.lit])
    return np.nan_to_num(seen.off_px[effects.lit].ravel()), np.nan_to_num(wavefront)


def _rms(values: Array, zones: int) -> float:
    """Return the rms over zones of the length of their vectors."""
    return float(np.sqrt(np.sum(values**2) / max(zones, 1)))
