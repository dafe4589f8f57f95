"""A tolerance study from its configuration to its directory: started, gone on with, summed up, reported."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from holocal.app import configuration, session
from holocal.app.farm import Farm, gathered
from holocal.errors import HolocalError, Interrupted
from holocal.loop.record import RunRecord
from holocal.loop.signals import interruptible
from holocal.records.files import write_bytes, write_json
from holocal.records.journal import Journal
from holocal.records.rig import RigConfig, fingerprint
from holocal.records.tolerance_model import Study
from holocal.records.validate import validated
from holocal.tolerance.bench_error import bench_error
from holocal.tolerance.cases import Case, cases
from holocal.tolerance.design import Design, design_of
from holocal.tolerance.summary import summary
from holocal.tolerance.table import benches_csv

PROCEDURE = "tolerance"
JOURNAL = "benches.jsonl"
SECONDS_EACH = 0.12  # a bench on one core: for --dry-run only

Said = Callable[[int, int], object]


@dataclass(frozen=True)
class Piece:
    """A bench to be traced: what a worker is sent."""

    design: Design
    case: Case


@dataclass(frozen=True)
class Done:
    """A finished study: its directory, its `result.json`, and whether the yield after correction is the wanted one."""

    directory: Path
    result: Mapping[str, Any]

    @property
    def exit_status(self) -> int:
        """0 where the wanted yield is reached, 3 where it is not."""
        return 0 if self.result["targets_met"] else 3


def is_study(directory: Path) -> bool:
    """Return whether a run directory is that of a tolerance study."""
    path = directory / "config.toml"
    try:
        return bool(tomllib.loads(path.read_text(encoding="utf-8")).get("procedure") == PROCEDURE)
    except (OSError, ValueError):
        return False


def trace(piece: Piece) -> dict[str, Any]:
    """Return the image errors of a bench; this is what runs in a worker."""
    return bench_error(piece.design, piece.case.freedoms)


def plan(study: Study, rig: RigConfig, farm: Farm) -> dict[str, Any]:
    """Return what a study would do (``--dry-run``), JSON-ready."""
    design_of(rig.simulated, study.wavelength_nm)
    count = sum(1 for _ in cases(study, 0))
    return {
        "schema": 1,
        "dry_run": True,
        "procedure": PROCEDURE,
        "rig": rig.name,
        "benches": study.benches,
        "traces": count,
        "expected_seconds": count * SECONDS_EACH / max(1, farm.workers),
        "parameters": study.model_dump(mode="json"),
    }


def start(rig: RigConfig, study: Study, *, seed: int, runs: Path, farm: Farm, said: Said) -> Done:
    """Return the result of a new study."""
    design_of(rig.simulated, study.wavelength_nm)
    config = configuration.RunConfig(PROCEDURE, rig, study, {}, seed, {})
    record = RunRecord.create(runs, PROCEDURE, config=config.toml(), identity={"rig": rig.name, **fingerprint(rig)})
    return _run(record, rig, study, seed, farm, said)


def resume(directory: Path, *, farm: Farm, said: Said) -> Done:
    """Return the result of a study that was cut off: benches that its journal has are not traced again."""
    record = RunRecord.reopen(directory)
    config = record.config()
    session.check_version(directory)
    study = validated(Study, config["parameters"], source=str(directory / "config.toml"))
    return _run(record, configuration.stored_rig(config), study, int(config["seed"]), farm, said)


def _run(record: RunRecord, rig: RigConfig, study: Study, seed: int, farm: Farm, said: Said) -> Done:
    began = time.monotonic()
    with interruptible(), record.open():
        record.journal("opened", benches=study.benches, farm=str(farm))
        try:
            design = design_of(rig.simulated, study.wavelength_nm)
            pieces = {case.key: Piece(design, case) for case in cases(study, seed)}
            found = gathered(trace, pieces, farm, Journal(record.directory / JOURNAL), said)
            result = _result(record.directory, rig, study, seed, found, time.monotonic() - began)
            write_bytes(record.directory / "benches.csv", benches_csv(study, seed, found).encode())
            write_json(record.directory / "result.json", result)
            record.journal("concluded", sentence=result["sentence"])
            record.finish("complete", render=session.safe_report)
        except KeyboardInterrupt as error:
            stopped = Interrupted("stopped by the operator.", fix=f"`holocal resume {record.directory}` goes on.")
            record.finish("interrupted", render=None, error=stopped.as_json())
            raise stopped from error
        except HolocalError as error:
            record.finish("failed", render=None, error=error.as_json())
            raise
    return Done(record.directory, result)


def _result(
    directory: Path, rig: RigConfig, study: Study, seed: int, found: Mapping[str, Any], seconds: float
) -> dict[str, Any]:
    said = summary(study, seed, found)
    wanted = study.tolerances.wanted_yield
    met = said["after"]["yield"] >= wanted
    return {
        "schema": 1,
        "procedure": PROCEDURE,
        "rig": rig.name,
        "run": str(directory),
        "targets_met": met,
        "frames": 0,
        "benches": study.benches,
        "traces": len(found),
        "seconds": seconds,
        "seed": seed,
        "wavelength_nm": study.wavelength_nm,
        "sentence": _sentence(said, study),
        **said,
        "tolerances": study.tolerances.model_dump(mode="json"),
    }


def _sentence(said: Mapping[str, Any], study: Study) -> str:
    before, after, pose = (said[stage]["yield"] for stage in ("before", "after", "pose"))
    wanted = study.tolerances.wanted_yield
    text = (
        f"of {study.benches} benches {before:.1%} are within the spec as they are built, {after:.1%} after correction "
        f"by the procedures, {pose:.1%} with a hologram of their own pose (wanted {wanted:.0%})"
    )
    scale = said["scale"]["after"]
    if scale["at_wanted_yield"] is None:
        return f"{text}; correction suffices to {scale['largest']:g} times these tolerances and beyond"
    first = next(iter(scale["first_missed"]), "")
    return f"{text}; correction suffices up to {scale['at_wanted_yield']:.2f} times these tolerances, then: {first}"
