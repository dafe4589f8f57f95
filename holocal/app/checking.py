"""The accepted calibration measured again in a few frames: does it hold, or has the bench drifted?

A number holds while it is at most its limit, the target that it was accepted under; it has drifted when it lies beyond
by more than `DRIFTED` standard errors, or when the frames no longer show what the calibration says. Each check is kept
in ``<home>/rigs/<rig>/checks/``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from holocal.app.configuration import stored_parameters
from holocal.app.session import claimed_rig, expectations
from holocal.errors import HolocalError, RefusedError
from holocal.loop.checking import Rechecked, recheck
from holocal.loop.devices import Repeatable
from holocal.loop.preflight import preflight, refuse_failed
from holocal.loop.procedure import Checkable
from holocal.loop.runner import PREFLIGHT_STEP, Observer
from holocal.loop.shooting import Shooter
from holocal.records import calibration, plugins
from holocal.records.calibration import Accepted
from holocal.records.checks import keep_check
from holocal.records.results import numbers_of
from holocal.records.rig import RigConfig, identity

SCHEMA = 1
DRIFTED = 2.0  # standard errors beyond the limit: a bench that stands at it is not reported every second time
HOLDS, IS_DRIFTED, NOT_CHECKED = "holds", "drifted", "not checked"


@dataclass(frozen=True)
class Checked:
    """What became of one accepted calibration: `verdict` is "holds", "drifted" or "not checked", with the sentence."""

    procedure: str
    entry: str
    verdict: str
    sentence: str
    numbers: Mapping[str, Mapping[str, float | None]]
    frames: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class CheckResult:
    """A check of a rig: `holds` when everything that was measured does."""

    rig: str
    utc: str
    checked: tuple[Checked, ...]
    seconds: float

    @property
    def holds(self) -> bool:
        """Whether nothing has drifted."""
        return all(one.verdict != IS_DRIFTED for one in self.checked)

    def as_json(self) -> dict[str, Any]:
        """Return the check, JSON-ready."""
        return {
            "schema": SCHEMA,
            "rig": self.rig,
            "utc": self.utc,
            "verdict": HOLDS if self.holds else IS_DRIFTED,
            "frames": sum(one.frames for one in self.checked),
            "seconds": round(self.seconds, 3),
            "checked": [asdict(one) for one in self.checked],
        }


def check(config: RigConfig, *, only: str | None, seed: int, observer: Observer) -> CheckResult:
    """Return whether the accepted calibration of a rig holds; the check is kept.

    Raises
    ------
    RefusedError
        There is none, it is another rig's or stale, the pre-flight failed, or nothing of it can be measured again.
    """
    began = time.monotonic()
    _require_accepted(config.name, calibration.in_force(config.name), only)
    with claimed_rig(config) as rig:
        facts = rig.facts()
        in_force = calibration.load(identity(facts))
        chosen = [name for name in in_force if only in (None, name)]
        found: dict[str, Any] = {name: _checkable(name) for name in chosen}
        if all(isinstance(one, str) for one in found.values()):
            raise RefusedError(
                f"nothing that is in force for {config.name} can be checked: {'; '.join(map(str, found.values()))}.",
                fix="Measure it again with `holocal run`.",
                code="not-checkable",
            )
        shooter = Shooter(rig, facts, lambda verdict, shot, _: observer.incident(f"{shot.label}: {verdict.sentence}"))
        _make_preflight(shooter, config, in_force, seed, observer)
        assert shooter.reference is not None
        checked = []
        for step, (name, procedure) in enumerate(found.items()):
            accepted = in_force[name]
            if isinstance(procedure, str):
                checked.append(Checked(name, accepted.entry, NOT_CHECKED, procedure, {}))
                continue
            observer.waiting(f"{name}, measured again")
            values = stored_parameters(procedure.parameters_model, {"parameters": accepted.parameters})
            again = recheck(
                procedure, rig, shooter, in_force, values, reference=shooter.reference, seed=seed, step=step
            )
            checked.append(judged(accepted, again))
    utc = datetime.now(UTC)
    done = CheckResult(config.name, utc.strftime("%Y-%m-%dT%H:%M:%SZ"), tuple(checked), time.monotonic() - began)
    keep_check(config.name, done.as_json(), utc)
    return done


def judged(accepted: Accepted, again: Rechecked) -> Checked:
    """Return whether an accepted calibration holds, by what was found anew."""
    if again.found is None:
        return _checked(accepted, again, IS_DRIFTED, f"the frames do not show what was accepted: {again.reason}")
    now = numbers_of({"after": again.found.after, "sigma": {"after": again.found.sigma}}, "after")
    numbers, sentences, holds = {}, [], True
    for name, was in numbers_of(accepted.result, "after").items():
        number, limit = now.get(name), was.target
        if number is None or limit is None:
            continue
        sigma = number.sigma or 0.0
        beyond = number.value > limit + DRIFTED * sigma
        holds = holds and not beyond and sigma <= limit
        said = " beyond" if beyond else "" if sigma <= limit else " cannot be told from"
        sentences.append(f"{name} {number.text}{said} (limit {limit:g}, accepted with {was.value:.4g})")
        numbers[name] = {"value": number.value, "sigma": number.sigma, "limit": limit, "accepted": was.value}
    if not numbers:
        return _checked(accepted, again, NOT_CHECKED, "none of its numbers has a target")
    return _checked(accepted, again, HOLDS if holds else IS_DRIFTED, "; ".join(sentences), numbers)


def _checked(
    accepted: Accepted,
    again: Rechecked,
    verdict: str,
    sentence: str,
    numbers: Mapping[str, Mapping[str, float | None]] | None = None,
) -> Checked:
    return Checked(
        accepted.procedure, accepted.entry, verdict, sentence, numbers or {}, again.frames, round(again.seconds, 3)
    )


def _require_accepted(rig: str, accepted: Mapping[str, str], only: str | None) -> None:
    if accepted and (only is None or only in accepted):
        return
    what = f"no accepted {only} calibration" if only and accepted else "no accepted calibration"
    raise RefusedError(
        f"rig {rig} has {what}.",
        why="There is nothing that could have drifted.",
        fix=f"Measure and accept one: `holocal run {only or 'uniformity'} --rig {rig}`, then `holocal accept`.",
        measured=", ".join(accepted) or "none",
        limit=only or "one",
        code="no-calibration",
    )


def _checkable(name: str) -> Any:
    """Return the procedure of an accepted calibration, or why it cannot be measured again."""
    try:
        procedure = plugins.procedure(name)
    except HolocalError as error:
        return error.what
    return procedure if isinstance(procedure, Checkable) else f"the procedure {name} has no quick check"


def _make_preflight(
    shooter: Shooter, config: RigConfig, in_force: Mapping[str, Accepted], seed: int, observer: Observer
) -> None:
    observer.waiting("the pre-flight")
    began = time.monotonic()
    if isinstance(shooter.rig, Repeatable):
        shooter.rig.begin_step(seed, PREFLIGHT_STEP)
    expected = expectations(config, {name: one.entry for name, one in in_force.items()})
    checks = preflight(shooter, shooter.facts, None, calibration.rig_directory(config.name), expected)
    observer.preflight(checks, time.monotonic() - began)
    refuse_failed(checks)
    shooter.frames = 0
