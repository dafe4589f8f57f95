"""A rig, its lock, its corrections and a procedure put together for one run, fresh or resumed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from holocal import __version__
from holocal.app import configuration
from holocal.app.report import render_report
from holocal.errors import DeviceError, RefusedError
from holocal.loop.devices import Rig
from holocal.loop.ending import close_quietly, dark_at_the_end
from holocal.loop.lock import locked
from holocal.loop.preflight import Expectations
from holocal.loop.record import RunRecord
from holocal.loop.runner import Observer, RunResult, run
from holocal.loop.shooting import EXPOSURE_EXCESS, guarded
from holocal.loop.signals import interruptible, shielded
from holocal.records import calibration, index, plugins
from holocal.records.files import read_json
from holocal.records.rig import RigConfig, identity
from holocal.records.run_files import begun
from holocal.records.safety import safety_of

LOGGER = logging.getLogger("holocal.app")
CORRECTIONS = ("accepted", "none")


@contextmanager
def opened_rig(config: RigConfig) -> Iterator[Rig]:
    """Yield the opened rig of a configuration; it is closed on every way out, SIGTERM's and SIGHUP's too."""
    open_rig = plugins.load(plugins.RIGS, config.kind)
    with interruptible():
        with shielded(held_back=1) as signalled:  # a rig that was opened and not yet told of would not be closed
            rig = _opened(open_rig, config)
        try:
            if signalled:
                raise KeyboardInterrupt
            _require_ceiling(rig, config)
            yield rig
        finally:
            close_quietly(rig.close, f"rig {config.name}")


def _opened(open_rig: Callable[[RigConfig], Rig], config: RigConfig) -> Rig:
    try:
        return open_rig(config)
    except OSError as error:
        raise DeviceError(
            f"rig {config.name} cannot be opened: {error}.", fix="Check its cables and power; `holocal doctor`."
        ) from error


@contextmanager
def claimed_rig(config: RigConfig) -> Iterator[Rig]:
    """Yield the opened rig while no other process has it, dark before and after; `BusyError` when one does."""
    with locked(lock_of(config.name), f"rig {config.name}"), opened_rig(config) as rig, dark_at_the_end(rig):
        guarded(rig.light.off, "the light source")  # a program that was killed may have left it on
        guarded(rig.slm.blank, "the SLM")
        yield rig


@contextmanager
def asked_rig(config: RigConfig) -> Iterator[Rig]:
    """Yield a rig that is only asked for its facts; `BusyError` when another process works with the real one.

    Opening real devices makes them dark, in the midst of that process's measurement. A rig that was never claimed has
    no lock, and none is made: a dry run leaves nothing behind.
    """
    lock = lock_of(config.name)
    claimable = config.kind != "simulated" and lock.is_file()
    with locked(lock, f"rig {config.name}") if claimable else nullcontext(), opened_rig(config) as rig:
        yield rig


def lock_of(rig: str) -> Path:
    """Return where a rig's lock is."""
    return calibration.rig_directory(rig) / "lock"


def _require_ceiling(rig: Rig, config: RigConfig) -> None:
    """Raise `RefusedError` when a rig does not keep to the longest exposure of its own file, whatever opened it."""
    limit_s, longest_s = safety_of(config).max_exposure_s, rig.facts().camera.exposure_max_s
    if limit_s is not None and longest_s > limit_s * EXPOSURE_EXCESS:
        raise RefusedError(
            f"rig {config.name}: the camera allows {longest_s:g} s; safety.max_exposure_s = {limit_s:g} s.",
            why="The rig's plug-in does not keep to the limit of its own file.",
            fix=f"Have the plug-in {config.kind!r} limit its camera's exposure_max_s.",
            measured=longest_s,
            limit=limit_s,
            code="exposure-ceiling",
        )


def expectations(config: RigConfig, entries: Mapping[str, str], *, identities: bool = False) -> Expectations:
    """Return what a rig's pre-flight is held against.

    Parameters
    ----------
    entries
        Procedure -> the accepted run that is in force.
    identities
        Whether the rig must be that of the entries too; where they were loaded, that is known already.
    """
    file = {
        f"{device}.serial": serial
        for device in ("slm", "camera")
        if (serial := dict(config.tables.get(device, {})).get("serial"))
    }
    expected: dict[str, Mapping[str, Any]] = {Path(config.source).name: file} if file else {}
    if identities:
        folder = calibration.rig_directory(config.name) / "entries"
        expected |= {
            f"the accepted {name} calibration": read_json(folder / entry / "identity.json")
            for name, entry in entries.items()
        }
    return Expectations(
        lock=lock_of(config.name),
        identity=expected,
        measured_utc={name: begun(entry) for name, entry in entries.items()},
        max_age_days=safety_of(config).max_calibration_age_days,
    )


def corrections(choice: str, rig: Mapping[str, Any]) -> dict[str, calibration.Accepted]:
    """Return the corrections of ``--corrections accepted|none|RUN`` for the rig with this identity."""
    if choice == "none":
        return {}
    if choice == "accepted":
        return calibration.load(rig)
    found = calibration.read_run(Path(choice))
    calibration.check_identity(
        read_json(Path(choice) / "identity.json"),
        rig,
        subject=f"run {Path(choice).name}",
        fix="Name a run of this rig, or `--corrections none`.",
    )
    return found


def plan(procedure_name: str, rig: RigConfig, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a run would do (``--dry-run``), JSON-ready; nothing is shown, lit or written."""
    procedure = plugins.procedure(procedure_name)
    values, _ = configuration.parameters(
        procedure.parameters_model, overrides, procedure=procedure_name, device=rig.device
    )
    with asked_rig(rig) as device:
        planned = procedure.plan(device.facts(), values)
    return {
        "schema": 1,
        "dry_run": True,
        "procedure": procedure_name,
        "rig": rig.name,
        **asdict(planned),
        "parameters": values.model_dump(mode="json"),
    }


def start(
    procedure_name: str,
    rig: RigConfig,
    overrides: Mapping[str, Any],
    *,
    seed: int,
    runs: Path,
    corrections_choice: str,
    observer: Observer,
    keep_frames: bool = False,
) -> RunResult:
    """Return the result of a new run."""
    procedure = plugins.procedure(procedure_name)
    values, origins = configuration.parameters(
        procedure.parameters_model, overrides, procedure=procedure_name, device=rig.device
    )
    with claimed_rig(rig) as device:
        rig_identity = identity(device.facts())
        in_force = corrections(corrections_choice, rig_identity)
        entries = {name: found.entry for name, found in in_force.items()}
        config = configuration.RunConfig(procedure_name, rig, values, origins, seed, entries, keep_frames)
        index.remember(runs)
        record = RunRecord.create(runs, procedure_name, config=config.toml(), identity=rig_identity)
        with record.open():
            return run(
                procedure,
                device,
                values,
                seed=seed,
                record=record,
                calibration=in_force,
                observer=observer,
                render=safe_report,
                expected=expectations(rig, entries),
                keep_frames=keep_frames,
            )


def resume(directory: Path, *, observer: Observer) -> RunResult:
    """Return the result of a run that was cut off, interrupted or lost its device, from its last finished step."""
    record = RunRecord.reopen(directory)
    config = record.config()
    check_version(directory)
    rig, ended = configuration.without_faults(configuration.stored_rig(config))
    if ended:
        record.opening.append(("faults-over", {"faults": ended}))
    procedure = plugins.procedure(config["procedure"])
    values = configuration.stored_parameters(procedure.parameters_model, config)
    with claimed_rig(rig) as device, record.open():
        rig_identity = identity(device.facts())
        record.check_identity(rig_identity)
        in_force = _same_corrections(config.get("corrections", {}), rig_identity)
        return run(
            procedure,
            device,
            values,
            seed=int(config["seed"]),
            record=record,
            calibration=in_force,
            observer=observer,
            render=safe_report,
            expected=expectations(rig, {name: found.entry for name, found in in_force.items()}),
            keep_frames=bool(config.get("keep_frames", False)),
        )


def check_version(directory: Path) -> None:
    """Raise `RefusedError` unless a run was started with this version of holocal."""
    began = read_json(directory / "environment.json").get("packages", {}).get("holocal")
    if began != __version__:
        raise RefusedError(
            f"{directory.name} was started with holocal {began}; this is {__version__}.",
            why="Its two halves would be measured by different rules.",
            fix="Go on with that version, or start a new run.",
            measured=__version__,
            limit=began,
            code="other-version",
        )


def _same_corrections(began: Mapping[str, str], rig: Mapping[str, Any]) -> dict[str, calibration.Accepted]:
    if not began:
        return {}
    loaded = calibration.load(rig)
    now = {name: found.entry for name, found in loaded.items()}
    for name in sorted({*began, *now}):
        if began.get(name) != now.get(name):
            raise RefusedError(
                f"the run was started under {name} = {began.get(name) or 'none'}; "
                f"in force is {now.get(name) or 'none'}.",
                why="Its two halves would be measured under different corrections.",
                fix="`holocal accept --rollback`, or start a new run.",
                measured=now.get(name),
                limit=began.get(name),
                code="other-corrections",
            )
    return loaded


def safe_report(directory: Path) -> bytes:
    """Return a run's report; one that says why where it cannot be drawn, since a run must not fail by its report."""
    try:
        return render_report(directory)
    except Exception as error:  # whatever a plug-in's figures hold: a measured run is not lost by its drawing
        LOGGER.exception("the report could not be drawn")
        return (
            "<!doctype html><html lang='en'><meta charset='utf-8'><title>holocal</title><p>The report could not be "
            f"drawn ({type(error).__name__}); the numbers are in result.json, the reason is in log.txt.</p></html>"
        ).encode()
