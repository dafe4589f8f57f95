"""The zones' windows, and what all frames together say of their wavefronts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from holocal.estimate.field_model import FieldModel, ZoneEvidence, fit_field, modes_of, zone_evidence
from holocal.estimate.spot_fit import ZoneProblem
from holocal.estimate.spot_model import Pupil, PupilBox, Seen, SpotModel, Window
from holocal.estimate.spot_places import SpotPlaces
from holocal.estimate.zone_data import Noise, Priors, ZoneData, ZoneFit
from holocal.estimate.zone_fits import fit_zones, pupil_place
from holocal.optics.zernike import noll_to_nm
from holocal.threads import each
from procedures._aberration_directions import better_jacobians, turned, windows_of
from procedures._aberration_spots import EDGE_M, REACH_M, SpotArray

Array = NDArray[np.float64]

BOX_MARGIN_M = 0.15e-3  # light of the panel's edges spreads so far by the window's own resolution
SPAN_M = 0.5e-3  # beyond the pupil's nominal rim its light may come from
ABOVE = 1  # degrees of the wavefront that are fitted above those wanted
LEAST_LIGHT = 30.0  # of a spot, over the noise of its window: below, the zone is dark
LARGEST_CHI2 = 3.0  # times the median (at least 1): above, a zone's fit is not believed
LARGEST_OFF = 100.0  # chi-square per mode between a zone and what the others say of it
# Prior of a picture's stretch once the fits have placed the spots: by many, and by too few for a curved map.
AFFINE_PLACED, AFFINE_BY_FEW = 0.003, 0.01
FIRST_LOOK = (0, 1)  # frames of opposite defocus


@dataclass(frozen=True)
class Shown:
    """The frames of an estimate.

    `pictures` (n, height, width) counts less the dark level, `exposure_s` (n,), `defocus` (n,) in units of the array's,
    and what the panel's light held of every zone in each.
    """

    pictures: NDArray[np.float32]
    exposure_s: Array
    defocus: Array
    seen: Sequence[Sequence[Seen]]


@dataclass(frozen=True)
class CameraNoise:
    """`noise` of counts, `usable` pixels (height, width), and the count of a saturated pixel."""

    noise: Noise
    usable: NDArray[np.bool_]
    full_scale: int
    dark: Array  # (frames,) level that was subtracted


@dataclass(frozen=True)
class Estimate:
    """What frames say of all zones.

    `fits` per zone, None for one that could not be fitted, `reason` why, or why it is not believed; `windows`, `boxes`
    likewise; `field` joins them; `pupil_m` (2,) where the pupil lies; `affine` how well the pictures' stretch is known.
    """

    fits: tuple[ZoneFit | None, ...]
    windows: tuple[Window | None, ...]
    boxes: tuple[PupilBox | None, ...]
    models: tuple[SpotModel | None, ...]
    problems: tuple[ZoneProblem | None, ...]
    reasons: tuple[str, ...]
    field: FieldModel
    degree: int
    pupil_m: Array
    affine: float

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which zones were fitted and are believed."""
        return np.array([not reason for reason in self.reasons])


def estimate(
    array: SpotArray,
    places: SpotPlaces,
    shown: Shown,
    camera: CameraNoise,
    noll: tuple[int, ...],
    *,
    before: Estimate | None = None,
    device: str = "cpu",
) -> Estimate:
    """Return what frames say of all zones; `before` gives windows and a place to start from."""
    wanted = max(noll_to_nm(j)[0] for j in noll)
    degree = wanted + ABOVE
    priors = Priors() if before is None else replace(Priors(), affine=before.affine)
    if before is None:
        windows, reasons = windows_of(array, places)
    else:
        windows = list(before.windows)
        reasons = ["" if window is not None else said for window, said in zip(windows, before.reasons, strict=True)]

    def problem_of(zone: int) -> Part | None:
        return _problem(array, windows[zone], zone, shown, camera, degree, device)

    parts = each(problem_of, len(windows))
    for zone, part in enumerate(parts):
        if part is not None and _darkness(part[2]) < LEAST_LIGHT:
            parts[zone], reasons[zone] = None, "no light is seen where its spot should be"
    problems = [None if part is None else part[2] for part in parts]
    if before is not None:
        started = [
            None if fit is None or problem is None else problem.begun_at(fit.vector, fit.layout)
            for fit, problem in zip(before.fits, problems, strict=True)
        ]
        fits = fit_zones(problems, priors, wanted, started)
    else:  # two frames say where the spots are; then the windows' directions are set right, and all frames fitted
        fits = fit_zones([None if one is None else one.of_frames(FIRST_LOOK) for one in problems], priors, wanted)
        place = pupil_place(fits)
        boxes = [None if part is None else part[1] for part in parts]
        better = better_jacobians(array, places, windows, boxes, fits, degree, np.zeros(2) if place is None else place)
        if better is not None:
            windows, old_parts = turned(array, windows, better[0]), parts
            parts = each(lambda zone: None if old_parts[zone] is None else problem_of(zone), len(windows))
            fits = [
                None if fit is None or old is None or new is None else moved(fit, old[1], new[1], degree)
                for fit, old, new in zip(fits, old_parts, parts, strict=True)
            ]
            priors = replace(priors, affine=AFFINE_PLACED if better[1] else AFFINE_BY_FEW)
            problems = [None if part is None else part[2] for part in parts]
        started = [
            None if fit is None or problem is None else problem.begun_at(fit.vector, fit.layout)
            for fit, problem in zip(fits, problems, strict=True)
        ]
        fits = fit_zones(problems, priors, wanted, started)
    boxes = [None if part is None else part[1] for part in parts]
    models = [None if part is None else part[0] for part in parts]
    place = pupil_place(fits)
    field, reasons = joined(array, fits, boxes, reasons, degree, noll)
    return Estimate(
        tuple(fits),
        tuple(windows),
        tuple(boxes),
        tuple(models),
        tuple(problems),
        tuple(reasons),
        field,
        degree,
        np.zeros(2) if place is None else place,
        priors.affine,
    )


def moved(fit: ZoneFit, old: PupilBox, new: PupilBox, degree: int) -> ZoneFit:
    """Return a fit with its wavefront over another box; only its vector is that of the new one."""
    vector = fit.vector.copy()
    vector[fit.layout.wavefront] = rebased(vector[fit.layout.wavefront], old, new, degree)
    return replace(fit, vector=vector)


def rebased(terms: Array, old: PupilBox, new: PupilBox, degree: int) -> Array:
    """Return a wavefront's terms (without piston) over another box."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(-1, 1, (8 * (len(terms) + 1), 2)) * old.half_m + old.centre_m
    pupil = inside @ old.to_pupil
    values = old.legendre(pupil, degree)[:, 1:] @ terms
    return np.asarray(np.linalg.lstsq(new.legendre(pupil, degree), values, rcond=None)[0][1:])


def joined(
    array: SpotArray,
    fits: Sequence[ZoneFit | None],
    boxes: Sequence[PupilBox | None],
    reasons: Sequence[str],
    degree: int,
    noll: tuple[int, ...],
) -> tuple[FieldModel, list[str]]:
    """Return the field's model from the zones that are believed, and the reasons of those that are not."""
    said = list(reasons)
    known = [fit.chi2 for fit in fits if fit is not None]
    limit = LARGEST_CHI2 * max(float(np.median(known)) if known else 1.0, 1.0)
    for zone, fit in enumerate(fits):
        if fit is not None and not said[zone] and not fit.chi2 <= limit:
            said[zone] = f"its pictures do not fit: chi-square {fit.chi2:.1f} per pixel; the limit is {limit:.1f}"
    radius = array.facts.pupil_diameter_m / 2
    evidence: list[ZoneEvidence | None] = []
    for fit, box, reason in zip(fits, boxes, said, strict=True):
        usable = fit is not None and box is not None and not reason
        evidence.append(zone_evidence(fit, box, degree, radius) if usable else None)  # type: ignore[arg-type]
    half = np.tan(np.asarray(array.facts.camera.field_rad) / 2)
    half_tan = (float(half[0]), float(half[1]))
    while True:
        field = fit_field(evidence, array.field_tan, half_tan, modes_of(degree))
        off = [_off(field, evidence, zone) for zone in range(len(evidence))]
        worst = int(np.argmax(off))
        if off[worst] <= LARGEST_OFF or sum(e is not None for e in evidence) <= 4:
            return field.only(noll), said
        said[worst] = f"it disagrees with all other zones: chi-square {off[worst]:.0f} per mode"
        evidence[worst] = None


def _off(field: FieldModel, evidence: Sequence[ZoneEvidence | None], zone: int) -> float:
    """Return how far a zone's own evidence is from what the others predict, chi-square per mode."""
    one = evidence[zone]
    if one is None:
        return 0.0
    values, vectors = np.linalg.eigh(one.information)
    sure = values > 1e-3 * np.max(values)
    own = vectors[:, sure].T @ one.weighted / values[sure]
    difference = own - vectors[:, sure].T @ field.predicted[zone]
    spread = np.diag(1 / values[sure]) + vectors[:, sure].T @ field.predicted_covariance[zone] @ vectors[:, sure]
    return float(difference @ np.linalg.solve(spread, difference)) / int(np.count_nonzero(sure))


Part = tuple[SpotModel, PupilBox, ZoneProblem]


def _problem(
    array: SpotArray,
    window: Window | None,
    zone: int,
    shown: Shown,
    camera: CameraNoise,
    degree: int,
    device: str,
) -> Part | None:
    if window is None:
        return None
    facts = array.facts
    pupil = Pupil(facts.pupil_diameter_m / 2, EDGE_M, array.wavelength_m)
    seen = [frame[zone] for frame in shown.seen]
    q = seen[0][0]
    q = q[np.linalg.norm(q, axis=1) <= min(REACH_M, pupil.radius_m + SPAN_M)]
    if len(q) < 16:
        return None
    box = PupilBox.around(q, window, BOX_MARGIN_M)
    model = SpotModel(
        window, seen, box, pupil, degree=degree, device=device,
        bends_per_m=shown.defocus * array.bend_per_m[zone], bent_about_m=array.centre_m[zone],
    )  # fmt: skip
    counts = np.stack([window.cut(picture) for picture in shown.pictures]).astype(np.float64)
    good = np.stack(
        [
            (window.cut(picture) < camera.full_scale - dark - 0.5) & window.cut(camera.usable)
            for picture, dark in zip(shown.pictures, camera.dark, strict=True)
        ]
    )
    scale = np.asarray(shown.exposure_s, np.float64) / float(shown.exposure_s[0])
    return model, box, ZoneProblem(model, ZoneData(counts, good, scale), camera.noise)


def _darkness(problem: ZoneProblem) -> float:
    """Return a spot's light over the noise of its window."""
    data = problem.data
    light = float(np.sum(np.where(data.good, data.counts, 0.0)))
    pixels = max(int(np.count_nonzero(data.good)), 1)
    return light / float(np.sqrt(problem.noise.read_variance * pixels))
