"""The closed loop: shows, grabs, gates, journals, checkpoints, judges, verifies, stops. It knows no physics.

Whatever happens, the panel is blanked and the light switched off before `run` returns or raises
(`holocal.loop.ending`).
"""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from holocal.errors import HolocalError, Interrupted
from holocal.loop.devices import Frame, Repeatable, Rig
from holocal.loop.drift import Drift, drift_over_run
from holocal.loop.ending import dark_at_the_end
from holocal.loop.gates import Verdict
from holocal.loop.preflight import Check, Expectations, preflight, refuse_failed
from holocal.loop.preflight.checks import failed
from holocal.loop.preflight.expectations import NOTHING_EXPECTED
from holocal.loop.procedure import AgainstTruth, Conclusion, Judgement, Outcome, Plan, Procedure, Shot, ToldOfCamera
from holocal.loop.record import RunRecord
from holocal.loop.shooting import Shooter, Taken
from holocal.loop.signals import StopRequest, stop_requests
from holocal.records.facts import RigFacts
from holocal.records.files import json_ready
from holocal.records.run_files import part_entry

SCHEMA = 1
LOGGER = logging.getLogger("holocal.loop")
RESUMABLE = (6, 130)  # exit statuses after which `resume` goes on
PREFLIGHT_STEP = -1


class Observer(Protocol):
    """Who watches a run: the terminal, a page, a test. Nothing it does changes the run."""

    def preflight(self, checks: list[Check], seconds: float) -> None:
        """Be told the pre-flight's checks."""
        ...

    def waiting(self, what: str) -> None:
        """Be told what the run waits for."""
        ...

    def incident(self, sentence: str) -> None:
        """Be told of a bad frame or a halved exposure."""
        ...

    def step(self, number: int, progress: Mapping[str, Any], judgement: Judgement) -> None:
        """Be told a step's number of the goal and what was decided."""
        ...


@dataclass(frozen=True)
class RunResult:
    """How a run ended: the JSON of the contract, its sentence, and the exit status (0 targets met, 3 not)."""

    result: dict[str, Any]
    sentence: str
    directory: Path

    @property
    def exit_status(self) -> int:
        """Return 0 when every target holds, 3 otherwise."""
        return 0 if self.result["targets_met"] else 3


def run(
    procedure: Procedure[Any],
    rig: Rig,
    parameters: Any,
    *,
    seed: int,
    record: RunRecord,
    calibration: Mapping[str, Any],
    observer: Observer,
    render: Callable[[Path], bytes] | None = None,
    expected: Expectations = NOTHING_EXPECTED,
    keep_frames: bool = False,
) -> RunResult:
    """Return the result of one closed loop on an opened rig; goes on where `record` has a checkpoint.

    Parameters
    ----------
    procedure, parameters
        What is measured, and its checked parameters.
    seed
        All randomness comes from it and the number of the step.
    record
        The run's directory, held open by the caller.
    calibration
        Procedure -> `holocal.records.calibration.Accepted`: the corrections in force.
    observer
        Who is told how it goes.
    render
        Makes the report's bytes from the run's directory; the report and the manifest are written on every end.
    expected
        What the pre-flight holds the rig against besides its own facts.
    keep_frames
        Keep every frame, retakes and the pre-flight's included, with a journal line each: the run can be replayed.

    Raises
    ------
    HolocalError
        Refused, safety stop, device lost, interrupted, disk full; the record says so too.
    """
    with stop_requests() as stop:
        try:
            with dark_at_the_end(rig):
                loop = _Loop(procedure, rig, parameters, seed, record, calibration, observer, stop, expected)
                if keep_frames:
                    loop.keep_frames()
                done = loop.run()
        except (Exception, KeyboardInterrupt) as error:  # every end is written down, then raised
            written = _close_failed(record, error, render)
            if written is error:
                raise
            raise written from error
        observer.waiting("the report")
        record.finish("complete", render=render)
        return done


def _close_failed(record: RunRecord, error: BaseException, render: Callable[[Path], bytes] | None) -> BaseException:
    """Return the error to raise, after writing it to the journal, the log, the report and the manifest."""
    if isinstance(error, KeyboardInterrupt):
        error = _interrupted("SIGINT twice", record)
    if isinstance(error, HolocalError):
        said = error.as_json()
        LOGGER.error("%s", error)
    else:
        said = {"code": "bug", "what": f"{type(error).__name__}: {error}", "exit_status": 1}
        LOGGER.error("bug\n%s", "".join(traceback.format_exception(error)))
    resumable = said["exit_status"] in RESUMABLE
    try:
        record.journal("error", **{key: value for key, value in said.items() if value not in ("", None)})
        record.finish("interrupted" if resumable else "failed", render=render, error=said)
    except HolocalError as second:  # a full disk ends the record, and must not hide the first error
        LOGGER.error("the record could not be closed: %s", second)
    return error


def _interrupted(signal_name: str, record: RunRecord) -> Interrupted:
    return Interrupted(
        f"stopped by {signal_name}; every finished step is kept.",
        fix=f"Go on with `holocal resume {record.directory}`.",
        code="interrupted",
    )


class _Loop:
    """One run from its first frame, or its checkpoint, to its conclusion."""

    def __init__(
        self,
        procedure: Procedure[Any],
        rig: Rig,
        parameters: Any,
        seed: int,
        record: RunRecord,
        calibration: Mapping[str, Any],
        observer: Observer,
        stop: StopRequest,
        expected: Expectations,
    ) -> None:
        self.procedure, self.rig, self.parameters, self.seed = procedure, rig, parameters, seed
        self.record, self.calibration, self.observer, self.stop = record, calibration, observer, stop
        self.expected = expected
        self.facts: RigFacts = rig.facts()
        self.plan: Plan = procedure.plan(self.facts, parameters)
        self.shooter = Shooter(rig, self.facts, self._incident)
        self.step = 0
        self.now = PREFLIGHT_STEP  # which step's frames are being taken
        self.preflight_frames = 0
        self.shots: list[dict[str, Any]] = []
        self.seconds_before = 0.0
        self.started = time.monotonic()

    def keep_frames(self) -> None:
        """Have every frame from now on kept."""
        self.shooter.taken = self._keep

    def run(self) -> RunResult:
        found = self.record.resume()
        if self.shooter.taken is not None:
            self.record.journal("camera", **asdict(self.facts.camera))
        for event, values in self.record.opening:
            self.record.journal(event, **values)
        self._preflight()
        if found is None:
            self.observer.waiting("the first pattern")
            state = self.procedure.start(self.facts, self.calibration, self.parameters, self.seed)
            if isinstance(self.procedure, ToldOfCamera) and self.shooter.reference is not None:
                state = self.procedure.with_camera(state, self.shooter.reference)
            self.record.checkpoint(state, step=0, frames=0, seconds=self.seconds())
            judgement = Judgement(Outcome.CONTINUE, "")
        else:
            state, progress = found
            self.step, self.shooter.frames, self.seconds_before = progress.step, progress.frames, progress.seconds
            LOGGER.info("resumed at step %d", self.step)
            first = self.step == 0
            judgement = Judgement(Outcome.CONTINUE, "") if first else self.procedure.judge(state)
        while judgement.outcome is Outcome.CONTINUE:
            self._stop_if_asked()
            state, judgement = self._one_step(state)
        return self._verify(state, judgement)

    def seconds(self) -> float:
        """Return the time used by this run, earlier sittings included."""
        return self.seconds_before + time.monotonic() - self.started

    def _preflight(self) -> None:
        self.observer.waiting("the pre-flight")
        self._begin(PREFLIGHT_STEP)
        began = time.monotonic()
        checks = preflight(self.shooter, self.facts, self.plan, self.record.directory, self.expected)
        self.preflight_frames, self.shooter.frames = self.shooter.frames, 0
        self.record.preflight([item.as_json() for item in checks], frames=self.preflight_frames)
        self.observer.preflight(checks, time.monotonic() - began)
        if refused := [item.id for item in failed(checks)]:
            last = self.shooter.last_frame
            name = None if last is None else self.record.keep_bad_frame(f"bad-preflight-{refused[0]}", last.counts)
            self.record.journal("preflight", failed=refused, file=name)
        refuse_failed(checks)

    def _one_step(self, state: Any) -> tuple[Any, Judgement]:
        self.observer.waiting(f"step {self.step + 1}")
        frames = self._frames(self.procedure.stimuli(state))
        state = self.procedure.update(state, frames)
        self.step += 1
        progress = json_ready(self.procedure.progress(state))
        judgement = self.procedure.judge(state)
        self.record.journal(
            "step",
            step=self.step,
            progress=progress,
            outcome=judgement.outcome.value,
            sentence=judgement.sentence,
            shots=self.shots,
            frames=self.shooter.frames,
        )
        self.record.checkpoint(state, step=self.step, frames=self.shooter.frames, seconds=self.seconds())
        LOGGER.info("step %d: %s %s", self.step, progress, judgement.sentence)
        self.observer.step(self.step, progress, judgement)
        return state, judgement

    def _verify(self, state: Any, judgement: Judgement) -> RunResult:
        self._stop_if_asked()
        self.observer.waiting("the verification")
        frames = self._frames(self.procedure.verification(state))
        drift = self._drift()
        self.observer.waiting("the result")
        conclusion = self.procedure.conclude(state, frames)
        if drift is not None and not drift.ok:
            sentence = f"{conclusion.sentence}; but {drift.sentence}: measured anew it may differ"
            conclusion = replace(conclusion, targets_met=False, sentence=sentence)
        result = self._result(conclusion, judgement) | {"source_drift": None if drift is None else drift.relative}
        self.record.journal("verified", sentence=conclusion.sentence, after=conclusion.after, shots=self.shots)
        self.record.conclusion(conclusion, result)
        self._write_parts(conclusion, result)
        LOGGER.info("%s", conclusion.sentence)
        return RunResult(result, conclusion.sentence, self.record.directory)

    def _write_parts(self, conclusion: Conclusion, result: Mapping[str, Any]) -> None:
        """Write the results of a run of several procedures, each with those before it that it was measured under."""
        corrections = {key: entry for key, entry in result["corrections"].items() if key not in conclusion.parts}
        for name, part in conclusion.parts.items():
            shared = {key: result[key] for key in ("schema", "rig", "run", "seed")}
            said = {**shared, "procedure": name, **told(part), "corrections": dict(corrections)}
            if "truth" in result:
                said["truth"] = result["truth"].get(name, {})
            self.record.part(name, part, dict(json_ready(said)))
            if part.targets_met and part.extra.get("correction") != "none":
                corrections[name] = part_entry(self.record.directory.name, name)

    def _drift(self) -> Drift | None:
        """Return how far the light drifted since the pre-flight, and write it down."""
        frames = self.shooter.frames
        drift = drift_over_run(self.shooter, self.facts, self.plan)
        self.preflight_frames, self.shooter.frames = self.preflight_frames + self.shooter.frames - frames, frames
        if drift is not None:
            self.record.journal("drift", relative=drift.relative, limit=drift.limit, ok=drift.ok)
            if not drift.ok:
                LOGGER.warning("%s", drift.sentence)
                self.observer.incident(drift.sentence)
        return drift

    def _frames(self, shots: Iterator[Shot]) -> tuple[Frame, ...]:
        """Return a step's frames; a shot is computed only when the one before was taken."""
        self._begin(self.step)
        self.shots = []
        frames: list[Frame] = []
        for shot in shots:
            self.observer.waiting(shot.label)
            frame = self.shooter.shoot(shot)
            name = None
            if shot.keep:
                name = self.record.keep_frame(f"{self.step:02d}-{len(frames):02d}-{shot.label}", frame.counts)
            self.shots.append(
                {
                    "label": shot.label,
                    "exposure_s": frame.exposure_s,
                    "saturated_fraction": frame.saturated_fraction,
                    "mean_counts": float(np.mean(frame.counts)),
                    **({"file": name} if name else {}),
                }
            )
            frames.append(frame)
        return tuple(frames)

    def _begin(self, step: int) -> None:
        self.now = step
        self.shooter.begin_step()
        if isinstance(self.rig, Repeatable):
            self.rig.begin_step(self.seed, step)

    def _stop_if_asked(self) -> None:
        if self.stop:
            raise _interrupted(str(self.stop.name), self.record)

    def _keep(self, taken: Taken) -> None:
        frame, step = taken.frame, "pre" if self.now == PREFLIGHT_STEP else f"{self.now:02d}"
        whole = frame.counts.dtype == np.uint16 and frame.counts.size > 0  # what else comes is kept by its gate
        self.record.journal(
            "grab",
            step=self.now,
            shot=taken.shot.label,
            lit=taken.lit,
            levels_sha256=taken.levels_sha256,
            wavelength_m=taken.shot.wavelength_m,
            asked_s=taken.asked_s,
            exposure_s=frame.exposure_s,
            frame_id=frame.frame_id,
            lost_packets=frame.lost_packets,
            file=self.record.keep_frame(f"grab-{step}-{frame.frame_id:06d}", frame.counts) if whole else None,
        )

    def _incident(self, verdict: Verdict, shot: Shot, frame: Frame) -> None:
        name = self.record.keep_bad_frame(f"bad-{self.step:02d}-{shot.label}-{frame.frame_id}", frame.counts)
        said = {key: value for key, value in asdict(verdict).items() if key != "ok"}
        self.record.journal("incident", step=self.step, shot=shot.label, **said, file=name)
        LOGGER.warning("%s: %s", shot.label, verdict.sentence)
        self.observer.incident(f"{shot.label}: {verdict.sentence}")

    def _result(self, conclusion: Conclusion, judgement: Judgement) -> dict[str, Any]:
        extra: dict[str, Any] = {}
        truth = self.rig.truth()
        if truth is not None:
            judge = self.procedure if isinstance(self.procedure, AgainstTruth) else None
            extra["truth"] = {**truth, **(judge.against_truth(conclusion, truth) if judge else {})}
        result = {
            "schema": SCHEMA,
            "procedure": self.procedure.name,
            "rig": self.facts.name,
            "run": str(self.record.directory),
            "outcome": judgement.outcome.value,
            "frames": self.shooter.frames,
            "preflight_frames": self.preflight_frames,
            "steps": self.step,
            "seconds": round(self.seconds(), 3),
            "seed": self.seed,
            **told(conclusion),
            "corrections": {name: found.entry for name, found in self.calibration.items()},
        }
        if conclusion.parts:
            result["parts"] = list(conclusion.parts)
        return dict(json_ready({**result, **extra}))


def told(conclusion: Conclusion) -> dict[str, Any]:
    """Return the keys of a result that say what was found."""
    return {
        "targets_met": bool(conclusion.targets_met),
        "sentence": conclusion.sentence,
        "before": conclusion.before,
        "after": conclusion.after,
        "targets": conclusion.targets,
        "sigma": {side: dict(known) for side, known in conclusion.sigma.items()},
        **conclusion.extra,
    }
