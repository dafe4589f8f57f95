"""The panel's phase response: what phase each level gives, from frames of one level each among random fixed levels.

Every camera pixel sees a fringe as the level runs through the panel's range, each with its own phase; together they
give the phases of the levels (`holocal.estimate.fringes`), with no word on optics, alignment or speckle. Some levels
are measured, the later ones where the curve bends; the others are interpolated (`holocal.estimate.response`). Two
holograms tell the sign. The verification measures other levels with another pattern.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from holocal.errors import RefusedError
from holocal.estimate.fringes import FEWEST_LEVELS, Fringes
from holocal.estimate.registration import blob_image
from holocal.estimate.response import ResponseTable, interpolate_response, next_levels, phase_difference, rms
from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Judgement, Outcome, Plan, Remeasured, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures._exposure import next_guess
from procedures._holograms import Engine, image_levels, response_in_force
from procedures._response_frames import PEAK_AT, REFERENCE, bright_counts, choose_pixels, light_of, phases_of
from procedures._response_patterns import MEASURED, VERIFIED, Pattern, pattern
from procedures._response_picture import TELLING, likeness, picture_exposure_s

Array = NDArray[np.float64]

SEARCHES = 4  # frames at most, for the exposure
GRID_STEPS = 3  # the first levels lie on an even grid, every third of it in each step
CLIP_LIMIT = 2e-3  # clipped pixels are left out: their share only guards the sensor
VERIFICATION = 1000  # the number that seeds the verification's pattern
FINER_ROWS_DIM = 0.6  # the verification's rows send up to 1.6 times as much light to the camera


class Parameters(BaseModel):
    """What may be chosen.

    `sign` says whether the phase rises with the level, "auto" lets two holograms tell. Where the table's expected error
    is `enough_rad` or less after the even grid of levels, no more are measured; 0: all `steps` are.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    target_rad: float = Field(default=0.02, gt=0.0, lt=1.0)
    steps: int = Field(default=5, ge=3, le=40)
    levels_per_step: int = Field(default=7, ge=3, le=64)
    enough_rad: float = Field(default=0.0, ge=0.0, lt=1.0)
    verify_levels: int = Field(default=10, ge=8, le=200)
    sign: Literal["auto", "rising", "falling"] = "auto"
    wavelength_nm: float = Field(default=515.0, gt=0.0)
    zones: int | None = Field(default=None, ge=1, le=64)  # of the holograms; None: warped patches
    iterations: int = Field(default=10, ge=0, le=1000)
    device: str = "cpu"


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps.

    `in_force` (levels,) is the table used before; `light` (frames, n) the counts above the dark frame of the chosen
    `pixels` at `exposure_s`, `shown` and `times` the level and place in time of each frame; `light_per_s` the counts of
    a whole frame. `exposure_s` 0 means that it is still looked for, from `guess_s`. `pictures` (3, height, width)
    counts per second, of blobs with the table in force, the measured one and its negative; `alike` how much they are
    so; `rising` the sign found, None while unknown.
    """

    facts: RigFacts
    parameters: Parameters
    in_force: Array
    seed: int
    step: int
    guess_s: float
    exposure_s: float
    searched: int
    light_per_s: float
    dark: NDArray[np.uint16] | None
    pixels: NDArray[np.int64]
    light: NDArray[np.float32]
    shown: tuple[int, ...]
    times: tuple[int, ...]
    measured: int
    fringes: Fringes | None
    table: ResponseTable | None
    pictures: NDArray[np.float32] | None
    alike: tuple[float, ...]
    rising: bool | None

    @property
    def count(self) -> int:
        """How many levels the panel has."""
        return int(2**self.facts.slm.bits)

    @property
    def engine(self) -> Engine:
        """How its holograms are computed."""
        chosen = self.parameters
        return Engine(chosen.wavelength_nm, chosen.zones, chosen.iterations, chosen.device)

    @property
    def all_measured(self) -> bool:
        """Whether all levels that are wanted were measured."""
        chosen, table = self.parameters, self.table
        enough = table is not None and table.valid and table.sigma_rms_rad <= chosen.enough_rad
        return self.measured >= chosen.steps or (self.measured >= GRID_STEPS and enough)

    @property
    def sign_known(self) -> bool:
        """Whether the sign is known: given, or told by two pictures that differ."""
        return self.parameters.sign != "auto" or (len(self.alike) == 3 and abs(self.alike[1] - self.alike[2]) > TELLING)


def levels_of_step(state: State) -> tuple[int, ...]:
    """Return the levels that the next measuring step shows, in order: drawn at random, between references."""
    chosen, last = state.parameters, state.count - 1
    if state.measured < GRID_STEPS:
        grid = np.unique(np.rint(np.linspace(0, last, 1 + GRID_STEPS * chosen.levels_per_step)).astype(int))[1:]
        levels = grid[(2, 0, 1)[state.measured] :: GRID_STEPS]  # the panel's last level is among the first
    else:
        assert state.table is not None
        levels = next_levels(state.table, np.array(state.shown, np.int64), chosen.levels_per_step)
    rng = np.random.default_rng([state.seed, state.step])
    # At both ends of a run a reference more: the noise is known from the first step, the drift to the last.
    last_step = chosen.steps - 1 if chosen.enough_rad == 0 else GRID_STEPS - 1  # there may be more: another reference
    closing = (REFERENCE,) if state.measured in (0, last_step, chosen.steps - 1) else ()
    return (REFERENCE, *(int(level) for level in rng.permutation(levels)), *closing)


def verify_levels(state: State) -> tuple[int, ...]:
    """Return the levels of the verification in order: far from all measured ones, spread over the whole range."""
    wanted, last = state.parameters.verify_levels, state.count - 1
    used = np.unique(state.shown)
    edges = np.linspace(0, last + 1, wanted + 1).astype(int)
    levels: list[int] = []
    for low, high in pairwise(edges):
        among = np.arange(low, max(high, low + 1))
        distance = np.abs(among[:, None] - used[None]).min(axis=1)
        levels.append(int(among[int(np.argmax(distance))]))
    order = np.random.default_rng([state.seed, VERIFICATION]).permutation(levels)
    half = len(order) // 2
    return (REFERENCE, *(int(v) for v in order[:half]), REFERENCE, *(int(v) for v in order[half:]), REFERENCE)


def pattern_of(state: State, *, verification: bool = False) -> Pattern:
    """Return the pattern of the measurement, or that of the verification: other pixels, finer rows."""
    slm = state.facts.slm
    period, number = (VERIFIED, VERIFICATION) if verification else (MEASURED, 0)
    return pattern(slm.height, slm.width, count=state.count, period=period, seed=(state.seed, number))


class Response:
    """The procedure `response` (see `holocal.loop.procedure.Procedure`)."""

    name = "response"
    parameters_model = Parameters

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        measured = parameters.steps * (parameters.levels_per_step + 1) + 2
        verified = parameters.verify_levels + 3
        frames = SEARCHES + 1 + measured + 3 + verified
        megapixels = facts.slm.width * facts.slm.height / 1e6
        return Plan(
            frames=frames,
            steps=1 + parameters.steps + 1,
            expected_seconds=3 + frames * (0.2 + 0.4 * megapixels),
            exposure_ceiling_s=facts.camera.exposure_max_s,
            sentences=(
                f"1 to {SEARCHES} frames to find the exposure, 1 without light",
                f"{measured} frames of a level each, {parameters.steps * parameters.levels_per_step} levels, level 0 "
                "every eighth for the source's drift",
                "3 holograms of blobs: which sign of the response gives the picture",
                f"{verified} frames of other levels with another pattern, for the verification alone",
            ),
            tolerated_drift=0.1,  # level 0 comes back every eighth frame, and the gains are found with the phases
        )

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known."""
        if 2**facts.slm.bits < FEWEST_LEVELS:
            raise RefusedError(
                f"The panel has {2**facts.slm.bits} levels; a fringe is told from {FEWEST_LEVELS} on.",
                why="An ellipse has five parameters.",
                fix="Work without a response.",
                measured=2**facts.slm.bits,
                limit=FEWEST_LEVELS,
                code="too-few-levels",
            )
        return State(
            facts=facts,
            parameters=parameters,
            in_force=response_in_force(calibration, facts, parameters.wavelength_nm),
            seed=seed,
            step=0,
            guess_s=float(np.sqrt(facts.camera.exposure_min_s * facts.camera.exposure_max_s)),
            exposure_s=0.0,
            searched=0,
            light_per_s=0.0,
            dark=None,
            pixels=np.zeros(0, np.int64),
            light=np.zeros((0, 0), np.float32),
            shown=(),
            times=(),
            measured=0,
            fringes=None,
            table=None,
            pictures=None,
            alike=(),
            rising=None,
        )

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the exposure's frame; then steps of levels, the dark frame before the first; then three pictures."""
        if state.exposure_s == 0:
            levels = pattern_of(state).levels(state.count // 2)
            yield _shot(state, "exposure", levels, exposure_s=state.guess_s, clip_limit=1.0, fresh=False)
            return
        if not state.all_measured:
            if state.dark is None:
                yield _shot(state, "dark", None)
            shown = pattern_of(state)
            for level in levels_of_step(state):
                yield _shot(state, f"level-{level}", shown.levels(level), fresh=False)
            return
        assert state.table is not None
        camera = state.facts.camera
        exposure_s = picture_exposure_s(state.light_per_s, (camera.height, camera.width), camera.full_scale)
        measured = state.table.phase_rad
        # "before" and the right sign's may be almost one pattern: the other comes between, so a kept one is noticed
        for name, table in (("rising", measured), ("falling", -measured), ("before", state.in_force)):
            image = blob_image(camera.height, camera.width)
            levels = image_levels(image, state.facts, state.engine, seed=state.seed, response_rad=table)
            yield _shot(state, f"picture-{name}", levels, exposure_s=exposure_s, clip_limit=1.0, keep=True)

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state with the exposure found, with these frames in the estimate, or with the sign."""
        if state.exposure_s == 0:
            return _with_exposure(replace(state, step=state.step + 1), frames[0])
        if not state.all_measured:
            return _with_levels(state, frames)
        return _with_pictures(replace(state, step=state.step + 1), frames)

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        if state.exposure_s == 0 or state.table is None:
            now = state.exposure_s or state.guess_s
            return {"quantity": "exposure", "value": now, "sigma": None, "target": None, "unit": "s"}
        fringes = state.fringes
        assert fringes is not None
        return {
            "quantity": "expected error of the table (rms), rad",
            "value": state.table.sigma_rms_rad,
            "sigma": None,
            "target": state.parameters.target_rad,
            "levels": len(fringes.levels),
            "range_rad": state.table.range_rad,
            "chi2": fringes.chi2 if fringes.valid else None,
            "pixels": int(np.count_nonzero(fringes.kept)),
            "likeness": list(state.alike),
        }

    def judge(self, state: State) -> Judgement:
        """Return whether another step pays."""
        if state.table is None or state.fringes is None:
            looking = state.exposure_s == 0
            return Judgement(Outcome.CONTINUE, "looking for the exposure" if looking else "exposure found")
        chosen, sigma = state.parameters, state.table.sigma_rms_rad
        said = f"{len(state.fringes.levels)} levels, expected error {sigma:.4f} rad, target {chosen.target_rad:g}"
        if not state.all_measured:
            return Judgement(Outcome.CONTINUE, said if state.table.valid else f"{said}: {state.fringes.reason}")
        if not state.table.valid:
            return Judgement(Outcome.STALLED, f"no fringe was found: {state.fringes.reason}")
        if state.rising is None:
            return Judgement(Outcome.CONTINUE, f"{said}: two pictures tell the sign")
        if not state.sign_known:
            return Judgement(Outcome.STALLED, f"{said}; the two pictures do not tell the sign")
        said += f"; the phase {'rises' if state.rising else 'falls'} with the level"
        return Judgement(Outcome.TARGET_MET if sigma <= chosen.target_rad else Outcome.OUT_OF_STEPS, said)

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield frames of levels that the estimate never used, with a pattern that it never used."""
        shown = pattern_of(state, verification=True)
        exposure_s = FINER_ROWS_DIM * state.exposure_s
        for level in verify_levels(state):
            yield _shot(state, f"verify-{level}", shown.levels(level), exposure_s=exposure_s, fresh=False)

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result; "after" is measured on the verification's frames only."""
        from procedures._response_result import conclusion

        assert state.dark is not None
        camera, shown = state.facts.camera, verify_levels(state)
        pixels = choose_pixels(frames, state.dark, camera)
        light = light_of(frames, state.dark, pixels, camera=camera, exposure_s=frames[0].exposure_s)
        return conclusion(state, phases_of(light, shown, range(len(shown))))

    def remeasure(
        self,
        facts: RigFacts,
        calibration: Mapping[str, Any],
        parameters: Parameters,
        reference: Reference,
        seed: int,
    ) -> Generator[Shot, Frame, Remeasured]:
        """Yield the frames that measure the accepted table; return how far it is from them."""
        from procedures._response_check import remeasured

        state = self.start(facts, calibration, parameters, seed)
        return remeasured(self, state, calibration[self.name])

    def against_truth(self, conclusion: Conclusion, truth: Mapping[str, Any]) -> dict[str, float]:
        """Return the error of the table against a simulated rig's own, piston taken out, for `result.json` alone."""
        own = truth.get("response_rad", {}).get(f"{conclusion.extra['wavelength_nm']:g}")
        if own is None:
            return {}
        found = conclusion.extra["response"]["phase_rad"]
        return {"phase_error_rms_rad": rms(phase_difference(found, own))}


def _shot(
    state: State,
    label: str,
    levels: NDArray[np.uint8] | None,
    *,
    exposure_s: float = 0.0,
    clip_limit: float = CLIP_LIMIT,
    keep: bool = False,
    fresh: bool = True,
) -> Shot:
    return Shot(
        label=label,
        levels=levels,
        exposure_s=exposure_s or state.exposure_s,
        wavelength_m=state.parameters.wavelength_nm * 1e-9,
        clip_limit=clip_limit,
        keep=keep,
        fresh=fresh,
    )


def _with_exposure(state: State, frame: Frame) -> State:
    """Return the state with the exposure at which the speckle's peaks do not clip, or with the next guess."""
    camera, bright = state.facts.camera, bright_counts(frame)
    guess = next_guess(frame, camera, brightest=bright, last=state.searched + 1 >= SEARCHES)
    if guess is not None:
        return replace(state, guess_s=guess, searched=state.searched + 1)
    wanted = frame.exposure_s * PEAK_AT * camera.full_scale / max(bright, 1.0)
    return replace(state, exposure_s=float(np.clip(wanted, camera.exposure_min_s, camera.exposure_max_s)))


def _with_levels(state: State, frames: Sequence[Frame]) -> State:
    """Return the state with a step's levels in the fringes and the table."""
    shown, camera = levels_of_step(state), state.facts.camera
    if state.dark is None:
        dark, frames = frames[0].counts, frames[1:]
        pixels = choose_pixels(frames, dark, camera)
        whole = np.mean([np.sum(frame.counts - dark.astype(np.float64)) / frame.exposure_s for frame in frames])
        empty = np.zeros((0, len(pixels)), np.float32)
        state = replace(state, dark=dark, pixels=pixels, light=empty, light_per_s=float(whole))
    # What the runner halved because it clipped stays halved: the steps to come do not clip anew.
    used_s = min(frame.exposure_s for frame in frames)
    state = replace(state, exposure_s=used_s, light=state.light * np.float32(used_s / state.exposure_s))
    assert state.dark is not None
    taken = light_of(frames, state.dark, state.pixels, camera=camera, exposure_s=used_s)
    state = replace(
        state,
        step=state.step + 1,
        measured=state.measured + 1,
        light=np.concatenate([state.light, taken]),
        shown=(*state.shown, *shown),
        times=(*state.times, *range(len(state.times), len(state.times) + len(shown))),
    )
    fringes = phases_of(state.light, state.shown, state.times)
    return replace(state, fringes=fringes, table=interpolate_response(fringes, state.count))


def _with_pictures(state: State, frames: Sequence[Frame]) -> State:
    """Return the state with the sign that the pictures tell, or that was given, put into the table."""
    assert state.dark is not None
    assert state.table is not None
    rising_frame, falling_frame, before = frames
    ordered = (before, rising_frame, falling_frame)
    seen = [(frame.counts - state.dark.astype(np.float32)) / np.float32(frame.exposure_s) for frame in ordered]
    alike = tuple(likeness(picture) for picture in seen)
    given = state.parameters.sign
    told = alike[2] <= alike[1] + TELLING  # unless the pictures speak against it, a phase rises with the level
    rising = told if given == "auto" else given == "rising"
    table = state.table if rising else replace(state.table, phase_rad=-state.table.phase_rad)
    pictures = np.stack(seen).astype(np.float32)
    return replace(state, pictures=pictures, alike=alike, rising=rising, table=table)
