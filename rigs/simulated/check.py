"""How far the rig is from the plain sum over its panel, on the bench of its file, the nominal one and misaligned ones.

``python -m rigs.simulated.check`` prints the rms error of intensity of small patches of directions (docs/physics.md 5).
With ``--rig simulated`` every one of the 4K panel's pixels counts, and a point takes a second or two.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from holocal.errors import HolocalError
from holocal.optics.bench import Array, Bench, Pose
from holocal.optics.phase_function import VirtualPoints
from holocal.optics.raytrace import connect
from holocal.records.rig import load_rig
from holocal.records.rig_model import SimulatedRig as Tables
from holocal.units import DEGREE, MM, NM
from rigs.simulated.aperture import PanelToPupil
from rigs.simulated.direct import DirectSum, relative_error
from rigs.simulated.image_plane import field_along
from rigs.simulated.optics import bench_of
from rigs.simulated.panel import before_modulation, modulation, pixels_of

STEP_DEG = 0.0098  # a speckle grain of the whole pupil
LARGEST_TURN_RAD, LARGEST_SHIFT_M = 0.3 * DEGREE, 0.2 * MM  # of the drawn misalignments, each axis
# Patches lie within this share of the panel's picture: beyond, the pupil's rim cuts most of the light.
FIELD_SHARE = 0.7


def patch_errors(
    tables: Tables, bench: Bench, wavelength_m: float, centres_tan: Array, *, points: int, seed: int
) -> list[float]:
    """Return the relative rms error of intensity of each patch of points x points directions, random levels shown."""
    slm, panel = tables.slm, pixels_of(tables.slm)
    before = before_modulation(slm, tables.illumination, wavelength_m)
    edge_m = tables.optics.pupil_edge_mm * MM
    to_pupil = PanelToPupil(
        bench, panel, wavelength_m, illumination=before, fill_factor=slm.fill_factor, pupil_edge_m=edge_m
    )
    levels = np.random.default_rng(seed).integers(0, 2**slm.bits, (panel.height, panel.width), dtype=np.uint8)
    light = modulation(slm, levels, wavelength_m)
    field = to_pupil.field(light)
    exact = DirectSum(bench, panel, wavelength_m, edge_m, before, slm.fill_factor)
    errors = []
    for centre in centres_tan:
        tangents = patch(centre, points)
        sines = (tangents / np.sqrt(1 + np.sum(tangents**2, axis=1, keepdims=True))).T
        found = field_along(to_pupil.grid, field, wavelength_m, (sines[0], sines[1]))
        errors.append(relative_error(found, exact.field(light, VirtualPoints.at(tangents))))
    return errors


def patch(centre_tan: Array, points: int, step_deg: float = STEP_DEG) -> Array:
    """Return points x points tangents around one, (n, 2), a speckle grain apart."""
    offset = (np.arange(points) - (points - 1) / 2) * np.radians(step_deg)
    dx, dy = np.meshgrid(offset, offset)
    return np.asarray(centre_tan + np.stack([dx.ravel(), dy.ravel()], axis=1))


def directions(bench: Bench, tables: Tables, count: int, rng: np.random.Generator) -> Array:
    """Return tangents (count, 2) that the panel lights on this bench, the middle of its picture first."""
    half = np.array(pixels_of(tables.slm).half_size_m) / bench.magnification / bench.eye_relief_m
    middle = connect(bench, np.zeros((1, 2)), np.zeros((1, 2))).field_tan[0]
    shares = rng.uniform(-FIELD_SHARE, FIELD_SHARE, (count, 2))
    shares[0] = 0.0
    return np.asarray(middle + shares * half)


def benches(tables: Tables, drawn: int, rng: np.random.Generator) -> Iterator[tuple[str, Bench]]:
    """Yield the file's own bench, the nominal one, and so many misaligned at random, each with its name."""
    own = bench_of(tables)
    yield "the file's", own
    yield "nominal", replace(own, mirror=Pose(), slm=Pose())
    for i in range(drawn):
        turns = rng.uniform(-LARGEST_TURN_RAD, LARGEST_TURN_RAD, (2, 3))
        shifts = rng.uniform(-LARGEST_SHIFT_M, LARGEST_SHIFT_M, (2, 3))
        mirror, slm = (Pose(tuple(turn), tuple(shift)) for turn, shift in zip(turns, shifts, strict=True))
        yield f"drawn {i + 1}", replace(own, mirror=mirror, slm=slm)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return 1 where an error is above the limit."""
    asked = _parser().parse_args(arguments)
    try:
        tables = load_rig(asked.rig, asked.set).simulated
    except HolocalError as error:
        sys.stderr.write(f"error {error.code}: {error}\n")
        return error.exit_status
    rng, worst = np.random.default_rng(asked.seed), 0.0
    for i, (name, bench) in enumerate(benches(tables, asked.benches, rng)):
        centres = directions(bench, tables, asked.patches, rng)
        if asked.only and name not in asked.only:
            continue
        errors = patch_errors(
            tables, bench, asked.wavelength_nm * NM, centres, points=asked.points, seed=asked.seed + i
        )
        worst = max(worst, *errors)
        for centre, wrong in zip(centres, errors, strict=True):
            x, y = np.degrees(np.arctan(centre))
            sys.stdout.write(f"{name:>12}  {x:+6.2f} {y:+6.2f} deg  {100 * wrong:.2f} %\n")
            sys.stdout.flush()
    sys.stdout.write(f"worst {100 * worst:.2f} % rms of intensity; the limit is {100 * asked.limit:g} %\n")
    return 0 if worst <= asked.limit else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m rigs.simulated.check", description=__doc__)
    parser.add_argument("--rig", default="simulated-small", help="a simulated rig's name or file")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one value of it")
    parser.add_argument(
        "--benches", type=int, default=3, help="how many benches to draw, beside the file's and nominal"
    )
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="of the benches, only this one (more than once)"
    )
    parser.add_argument("--patches", type=int, default=5, help="directions on each bench")
    parser.add_argument("--points", type=int, default=5, help="points of a patch each way")
    parser.add_argument("--wavelength-nm", type=float, default=515.0)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--limit", type=float, default=0.01, help="exit status 1 above it")
    return parser


if __name__ == "__main__":
    sys.exit(main())
