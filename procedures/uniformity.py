"""Brightness uniformity: measure the field, divide the image by it, verify on frames that no estimate has seen.

A white square is shown; the camera sees how bright each direction comes out. A frame of blobs tells where the camera
sees the image's points (`holocal.estimate.registration`). The image is then multiplied by weights that dim the brighter
parts, shown again with fresh initial phases, and the estimate is made anew from all frames of all steps together
(`holocal.estimate.brightness`), until it is good enough. The thesis's own estimator is the other choice.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from holocal.estimate.registration import Registration, blob_image, register
from holocal.loop.devices import Frame
from holocal.loop.procedure import Conclusion, Judgement, Outcome, Plan, Remeasured, Shot
from holocal.loop.reference import Reference
from holocal.records.facts import RigFacts
from procedures._holograms import Engine, image_levels, response_in_force
from procedures._uniformity_exposure import with_exposure
from procedures._uniformity_geometry import as_seen, image_region, in_image, require_registered

Array = NDArray[np.float64]

REFINE_FRAMES = (2, 6)  # of a step, least and most
REFINED_NOISE = 0.016  # of a block's mean over a step's frames, relative: coarse speckle is given more frames
VERIFICATION = 1000  # the step number that seeds the verification's initial phases


class Parameters(BaseModel):
    """What may be chosen; `block_px` is the side of the blocks over which speckle is averaged."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    estimator: Literal["gp", "thesis"] = "gp"
    target_rms: float = Field(default=0.015, gt=0.0, lt=1.0)
    target_9pt: float = Field(default=0.05, gt=0.0, lt=1.0)
    floor: float = Field(default=0.25, gt=0.01, lt=1.0)
    block_px: int = Field(default=33, ge=6, le=500)
    measure_frames: int = Field(default=2, ge=1, le=100)
    refine_frames: int | None = Field(default=None, ge=1, le=100)  # None: 2 to 6, as the speckle asks for
    verify_frames: int = Field(default=3, ge=2, le=100)
    max_steps: int = Field(default=2, ge=1, le=20)
    wavelength_nm: float = Field(default=515.0, gt=0.0)
    zones: int | None = Field(default=None, ge=1, le=64)  # None: warped patches; else the thesis's zones
    iterations: int = Field(default=10, ge=0, le=1000)
    device: str = "cpu"


@dataclass(frozen=True)
class State:
    """Everything the loop knows between steps.

    `frames` (n, height, width) are brightness per second of exposure, dark subtracted; `shown` (n,) says with which of
    `weights` (steps, height, width; of the image) each was shown; `dark` is the dark frame in counts, `first` a white
    frame of the exposure's search that is good enough to be used. `exposure_s` 0 means that it is still being looked
    for, from `guess_s`. `response_rad` is the phase of each level in force. `registration` maps the image to the
    picture; `valid`, `brightness`, `sigma` belong to the picture.
    """

    facts: RigFacts
    parameters: Parameters
    response_rad: Array
    seed: int
    step: int
    guess_s: float
    exposure_s: float
    searched: int
    dark: NDArray[np.float32] | None
    first: NDArray[np.float32] | None
    registration: Registration | None
    frames: NDArray[np.float32]
    shown: tuple[int, ...]
    weights: NDArray[np.float32]
    residual: tuple[float, ...]
    residual_sigma: tuple[float, ...]
    map_sigma: float
    block_noise: float
    gamma: float
    gamma_sigma: float
    valid: NDArray[np.bool_] | None
    brightness: NDArray[np.float32] | None
    sigma: NDArray[np.float32] | None


def refine_frames(block_noise: float) -> int:
    """Return how many frames a step takes, from the relative noise of a block in one frame."""
    return int(np.clip(np.ceil((block_noise / REFINED_NOISE) ** 2), *REFINE_FRAMES))


def frame_levels(weights: NDArray[np.floating[Any]], state: State, step: int, shot: int) -> NDArray[np.uint8]:
    """Return the levels that show an image of these intensities with the initial phase of (seed, step, shot)."""
    chosen = state.parameters
    engine = Engine(chosen.wavelength_nm, chosen.zones, chosen.iterations, chosen.device)
    seed = int(np.random.SeedSequence([state.seed, step, shot]).generate_state(1, np.uint64)[0])
    return image_levels(weights, state.facts, engine, seed=seed, response_rad=state.response_rad)


class Uniformity:
    """The procedure `uniformity` (see `holocal.loop.procedure.Procedure`)."""

    name = "uniformity"
    parameters_model = Parameters

    def plan(self, facts: RigFacts, parameters: Parameters) -> Plan:
        """Return what a run would do, touching nothing."""
        refine = parameters.refine_frames
        frames = 3 + parameters.measure_frames + parameters.verify_frames
        frames += parameters.max_steps * (refine or REFINE_FRAMES[0])
        megapixels = facts.slm.width * facts.slm.height / 1e6
        return Plan(
            frames=frames,
            steps=2 + parameters.max_steps,
            expected_seconds=3 + frames * (0.3 + 0.55 * megapixels),
            exposure_ceiling_s=facts.camera.exposure_max_s,
            sentences=(
                "1 frame or a few to find the exposure, 1 without light, 1 of blobs to register image and camera",
                f"{parameters.measure_frames} frames of a white field over the camera's field",
                f"up to {parameters.max_steps} steps of {refine or '2 to 6'} frames of the corrected field",
                f"{parameters.verify_frames} frames with fresh initial phases, for the verification alone",
            ),
        )

    def start(self, facts: RigFacts, calibration: Mapping[str, Any], parameters: Parameters, seed: int) -> State:
        """Return the first state: nothing is known; the weights are 1."""
        height, width = facts.camera.height, facts.camera.width
        return State(
            facts=facts,
            parameters=parameters,
            response_rad=response_in_force(calibration, facts, parameters.wavelength_nm),
            seed=seed,
            step=0,
            guess_s=float(np.sqrt(facts.camera.exposure_min_s * facts.camera.exposure_max_s)),
            exposure_s=0.0,
            searched=0,
            dark=None,
            first=None,
            registration=None,
            frames=np.zeros((0, height, width), np.float32),
            shown=(),
            weights=np.ones((1, height, width), np.float32),
            residual=(),
            residual_sigma=(),
            map_sigma=float("nan"),
            block_noise=float("nan"),
            gamma=0.95,
            gamma_sigma=float("nan"),
            valid=None,
            brightness=None,
            sigma=None,
        )

    def stimuli(self, state: State) -> Iterator[Shot]:
        """Yield the exposure's frame, then the dark frame and the white ones, then the corrected ones."""
        chosen, number = state.parameters, state.step
        if state.exposure_s == 0:
            # All searches show the same frame; clipping is what the search is there to end, so it is no incident.
            yield self._shot(state, "exposure", 0, 0, exposure_s=state.guess_s, clip_limit=1.0)
            return
        if state.dark is not None:
            for shot in range(chosen.refine_frames or refine_frames(state.block_noise)):
                yield self._shot(state, "corrected", number, shot)
            return
        yield self._shot(state, "dark", number, 0, dark=True)
        blobs = blob_image(state.facts.camera.height, state.facts.camera.width)
        # The panel sends its light where the image is bright: blobs are brighter than white by the ratio of the areas.
        exposure_s = max(state.exposure_s * float(blobs.mean()), state.facts.camera.exposure_min_s)
        yield self._shot(state, "blobs", number, 0, image=blobs, exposure_s=exposure_s, clip_limit=1.0, keep=True)
        for shot in range(chosen.measure_frames - (state.first is not None)):
            yield self._shot(state, "white", number, shot + 1, keep=shot == 0)

    def update(self, state: State, frames: tuple[Frame, ...]) -> State:
        """Return the state with the exposure found, or with these frames in the estimate and the weights made anew."""
        state = replace(state, step=state.step + 1)
        if state.exposure_s == 0:
            return with_exposure(state, frames[0])
        taken: list[NDArray[np.float32]] = []
        if state.dark is None:
            dark, blobs, frames = frames[0].counts.astype(np.float32), frames[1], frames[2:]
            found = require_registered(register(brightness_of(blobs, dark).astype(np.float64)))
            state = replace(state, dark=dark, registration=found)
            if state.first is not None:
                taken.append(state.first - dark / np.float32(state.exposure_s))
        assert state.dark is not None
        taken += [brightness_of(frame, state.dark) for frame in frames]
        current = len(state.weights) - 1
        return _estimated(
            replace(
                state,
                first=None,
                frames=np.concatenate([state.frames, np.stack(taken)]),
                shown=(*state.shown, *[current] * len(taken)),
            )
        )

    def progress(self, state: State) -> dict[str, Any]:
        """Return the journal line of the last step."""
        target = state.parameters.target_rms
        if not state.residual:
            return {
                "quantity": "exposure",
                "value": state.exposure_s or state.guess_s,
                "sigma": None,
                "target": None,
                "unit": "s",
            }
        return {
            "quantity": "non-uniformity (rms)",
            "value": state.residual[-1],
            "sigma": state.residual_sigma[-1],
            "target": target,
            "map_sigma": state.map_sigma,
            "gamma": state.gamma,
            "gamma_sigma": state.gamma_sigma,
            "frames": len(state.frames),
        }

    def judge(self, state: State) -> Judgement:
        """Return whether another step pays."""
        if not state.residual:
            return Judgement(
                Outcome.CONTINUE, "looking for the exposure" if state.exposure_s == 0 else "exposure found"
            )
        target = state.parameters.target_rms
        now, done = state.residual[-1], len(state.residual) - 1  # steps with a correction
        said = f"non-uniformity {now:.4f}, target {target:g}"
        if done == 0:
            return Judgement(Outcome.CONTINUE, f"{said}: the first correction is made")
        if state.map_sigma <= 0.7 * target and now <= 2 * target:
            # What was shown is near enough for the map to be trusted where it is now needed: its own error is what
            # the next correction leaves.
            known = f"the map is known to {state.map_sigma:.4f}"
            return Judgement(Outcome.TARGET_MET, f"{said}; {known}: corrected once more and verified on fresh frames")
        if done >= 2 and now > 2 * min(state.residual[1:]) and now > state.residual[0]:
            return Judgement(Outcome.DIVERGED, f"{said}: worse than before any correction")
        if done >= state.parameters.max_steps:
            return Judgement(Outcome.OUT_OF_STEPS, f"{said}: after {done} corrections, as many as were allowed")
        return Judgement(Outcome.CONTINUE, f"{said}: corrected again from {len(state.frames)} frames")

    def verification(self, state: State) -> Iterator[Shot]:
        """Yield fresh frames of the final correction."""
        for shot in range(state.parameters.verify_frames):
            yield self._shot(state, "verify", VERIFICATION, shot, keep=shot == 0)

    def conclude(self, state: State, frames: tuple[Frame, ...]) -> Conclusion:
        """Return the result; "after" is measured on the verification's frames only."""
        from procedures._uniformity_result import conclusion

        assert state.dark is not None
        dark = state.dark
        return conclusion(state, np.stack([brightness_of(frame, dark) for frame in frames]))

    def remeasure(
        self,
        facts: RigFacts,
        calibration: Mapping[str, Any],
        parameters: Parameters,
        reference: Reference,
        seed: int,
    ) -> Generator[Shot, Frame, Remeasured]:
        """Yield the frames that measure the accepted correction; return how uneven they are."""
        from procedures._uniformity_check import remeasured

        state = self.start(facts, calibration, parameters, seed)
        return remeasured(self, state, calibration[self.name])

    def _shot(
        self,
        state: State,
        label: str,
        step: int,
        number: int,
        *,
        dark: bool = False,
        image: Array | None = None,
        keep: bool = False,
        exposure_s: float = 0.0,
        clip_limit: float = 3e-4,
    ) -> Shot:
        return Shot(
            label=label,
            levels=None if dark else frame_levels(state.weights[-1] if image is None else image, state, step, number),
            exposure_s=exposure_s or state.exposure_s,
            wavelength_m=state.parameters.wavelength_nm * 1e-9,
            clip_limit=clip_limit,
            keep=keep,
        )


def brightness_of(frame: Frame, dark: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a frame's counts less the dark frame's, per second of exposure."""
    return np.asarray((frame.counts.astype(np.float32) - dark) / np.float32(frame.exposure_s))


def _estimated(state: State) -> State:
    """Return the state with the map of all frames, the residual of the last weights shown, and the next weights."""
    from holocal.estimate.blocks import block_means
    from holocal.estimate.brightness import fit_brightness, weights_for
    from procedures._uniformity_result import thesis_weights

    chosen = state.parameters
    blocks = block_means(state.frames.astype(np.float64), chosen.block_px)
    assert state.registration is not None
    seen = np.stack([as_seen(weights, state.registration) for weights in state.weights])
    log_of_step = np.log(block_means(seen, chosen.block_px).mean)
    found, used = fit_brightness(
        blocks,
        log_of_step[list(state.shown)],
        shown=image_region(state.registration),
        block_px=chosen.block_px,
        floor=chosen.floor,
    )
    valid = found.valid if state.valid is None else state.valid  # the field is fixed by the first estimate
    found = replace(found, valid=valid)
    shown = found.brightness * seen[-1] ** found.gamma
    now = shown[valid]
    sigma = float(np.sqrt(np.mean(found.sigma[valid] ** 2)))
    residual = float(now.std() / now.mean())
    if chosen.estimator == "thesis":
        weights = thesis_weights(state, seen[-1], valid)
    else:
        weights = weights_for(found, chosen.floor)
    weights = in_image(weights, state.registration)
    return replace(
        state,
        weights=np.concatenate([state.weights, weights[None].astype(np.float32)]),
        residual=(*state.residual, residual),
        residual_sigma=(*state.residual_sigma, sigma),
        map_sigma=sigma,
        block_noise=float(np.sqrt(np.median(blocks.relative_variance[used]))),
        gamma=found.gamma,
        gamma_sigma=found.gamma_sigma,
        valid=valid,
        brightness=found.brightness.astype(np.float32),
        sigma=found.sigma.astype(np.float32),
    )
