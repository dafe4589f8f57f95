"""The procedure `all`: stages in order, each with those before in force; one record, one verdict, one `accept`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from lab_bench.rig import open_rig
from pydantic import BaseModel

from holocal.app.export.contents import contents_of
from holocal.errors import Interrupted, RefusedError
from holocal.loop.procedure import Conclusion, Judgement, Outcome, Plan, Shot
from holocal.loop.record import RunRecord
from holocal.loop.runner import run
from holocal.records import calibration, index
from holocal.records.manifest import problems
from holocal.records.rig import identity, load_rig
from procedures import all as procedure


class Settings(BaseModel):
    """Of a stage that only counts."""

    good: bool = True
    corrects: bool = True
    device: str = "cpu"


@dataclass(frozen=True)
class Counting:
    """The state of a stage that only counts."""

    parameters: Settings
    told_of: tuple[str, ...]
    seed: int
    steps: int = 0


class Stage:
    """A stage of two steps, one frame each, that remembers what was in force when it began."""

    def __init__(self, name: str) -> None:
        self.name = name

    def plan(self, facts, parameters):
        return Plan(3, 2, 1.0, 0.02, ("two frames",), 0.1)

    def start(self, facts, calibration, parameters, seed):
        return Counting(parameters, tuple(calibration), seed)

    def stimuli(self, state):
        yield self.shot(state.seed, state.steps)

    def update(self, state, frames):
        return replace(state, steps=state.steps + 1)

    def progress(self, state):
        return {"quantity": "steps", "value": state.steps, "sigma": None, "target": 2}

    def judge(self, state):
        return Judgement(Outcome.TARGET_MET if state.steps == 2 else Outcome.CONTINUE, f"{state.steps} steps")

    def verification(self, state):
        yield self.shot(state.seed, 1000)

    def conclude(self, state, frames):
        picture = np.asarray(frames[0].counts, np.float32)
        good = state.parameters.good
        return Conclusion(
            before={"rms": 1.0},
            after={"rms": 0.1},
            targets={"rms": 0.2},
            targets_met=good,
            sentence="good" if good else "bad",
            maps={"correction.intensity_weight": picture / picture.max()},
            before_map=picture,
            after_map=picture,
            extent_deg=(-1.0, 1.0, -1.0, 1.0),
            sigma={"after": {"rms": 0.01}},
            extra={"told_of": list(state.told_of), "correction": "all" if state.parameters.corrects else "none"},
        )

    def shot(self, seed, number):
        levels = np.random.default_rng([seed, len(self.name), number]).integers(0, 256, (24, 32), np.uint8)
        return Shot("square", levels, 0.02, 515e-9)


class Watcher:
    """Remembers what was judged; stops after a step if told to."""

    def __init__(self, stop_at=None):
        self.judged, self.stop_at = [], stop_at

    def preflight(self, checks, seconds): ...

    def waiting(self, what): ...

    def incident(self, sentence): ...

    def step(self, number, progress, judgement):
        self.judged.append((progress["quantity"], judgement.outcome))
        if number == self.stop_at:
            raise KeyboardInterrupt


class Parameters(BaseModel):
    """Of two stages."""

    first: Settings = Settings()
    second: Settings = Settings()
    device: str = "cpu"

    def of(self, stage):
        return getattr(self, stage)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOLOCAL_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(procedure, "STAGES", (Stage("first"), Stage("second")))
    return tmp_path


def go(runs, *, watcher=None, record=None, in_force=None, **chosen):
    config = load_rig("lab-bench", {})
    rig = open_rig(config)
    text = 'procedure = "all"\n[rig]\nname = "lab-bench"\n[parameters.first]\ngood = true\n'
    record = record or RunRecord.create(runs, "all", config=text, identity=identity(rig.facts()))
    with record.open():
        return run(
            procedure.All(), rig, Parameters(**chosen), seed=5, record=record, calibration=in_force or {},
            observer=watcher or Watcher(),
        )  # fmt: skip


def test_each_stage_is_measured_with_those_before_it_in_force(home):
    watcher = Watcher()
    done = go(home / "runs", watcher=watcher)
    assert done.result["targets_met"] is True
    assert done.result["frames"] == 6
    assert [quantity for quantity, _ in watcher.judged] == [
        "first: steps", "first: steps", "first: rms", "second: steps", "second: steps",
    ]  # fmt: skip
    assert watcher.judged[-1][1] is Outcome.TARGET_MET
    parts = {name: json.loads((done.directory / name / "result.json").read_text()) for name in ("first", "second")}
    assert [part["told_of"] for part in parts.values()] == [[], ["first"]]
    assert parts["second"]["corrections"] == {"first": f"{done.directory.name}.first"}
    assert done.result["targets"] == {"first_rms": 0.2, "second_rms": 0.2}
    assert done.result["sigma"]["after"] == {"first_rms": 0.01, "second_rms": 0.01}


def test_a_stage_that_missed_its_targets_is_not_built_upon_and_the_run_is_not_met(home):
    done = go(home / "runs", first={"good": False})
    assert done.result["targets_met"] is False
    assert "not met: first" in done.result["sentence"]
    second = json.loads((done.directory / "second" / "result.json").read_text())
    assert second["told_of"] == [] and second["corrections"] == {}
    with pytest.raises(RefusedError, match="did not meet"):
        calibration.accept(done.directory, identity(open_rig(load_rig("lab-bench", {})).facts()))
    assert calibration.in_force("lab-bench") == {}


def test_a_stage_that_corrects_nothing_is_neither_built_upon_nor_accepted(home):
    done = go(home / "runs", first={"corrects": False})
    second = json.loads((done.directory / "second" / "result.json").read_text())
    assert second["told_of"] == []
    with pytest.raises(RefusedError, match="corrects nothing"):
        calibration.accept(done.directory, identity(open_rig(load_rig("lab-bench", {})).facts()))
    assert calibration.in_force("lab-bench") == {}


@pytest.mark.parametrize("stop_at", [1, 2, 3, 5])
def test_a_run_that_was_stopped_ends_as_an_unbroken_one(home, stop_at):
    whole = go(home / "whole")
    with pytest.raises(Interrupted):
        go(home / "broken", watcher=Watcher(stop_at))
    (directory,) = (home / "broken").iterdir()
    resumed = go(home / "broken", record=RunRecord.reopen(directory))
    for name in ("first", "second"):
        again, once = (json.loads((one.directory / name / "result.json").read_text()) for one in (resumed, whole))
        differing = {key for key in once if again[key] != once[key]}
        assert differing <= {"run", "corrections"}
    assert problems(resumed.directory) == []


def test_accept_puts_all_parts_in_force_at_once_and_rollback_takes_them_back(home):
    done = go(home / "runs")
    facts = identity(open_rig(load_rig("lab-bench", {})).facts())
    state = calibration.accept(done.directory, facts)
    name = done.directory.name
    assert state["accepted"] == {"first": f"{name}.first", "second": f"{name}.second"}
    loaded = calibration.load(facts)
    assert loaded["first"].result["after"] == {"rms": 0.1}
    assert loaded["first"].parameters == {"good": True}
    assert set(calibration.read_run(done.directory)) == {"first", "second"}
    calibration.rollback("lab-bench")
    assert calibration.in_force("lab-bench") == {}


def test_accept_of_a_run_of_which_a_part_was_changed_puts_nothing_in_force(home):
    done = go(home / "runs")
    (done.directory / "second" / "maps.exr").write_bytes(b"")
    with pytest.raises(Exception, match=r"second/maps\.exr has 0 bytes"):
        calibration.accept(done.directory, identity(open_rig(load_rig("lab-bench", {})).facts()))
    assert calibration.in_force("lab-bench") == {}


def test_the_parts_are_in_the_index_under_the_names_that_they_are_accepted_by(home):
    done = go(home / "runs")
    with index.opened(home / "runs") as known:
        found = {run.name: run for run in known.runs("lab-bench")}
    name = done.directory.name
    assert set(found) == {name, f"{name}.first", f"{name}.second"}
    assert found[f"{name}.first"].procedure == "first" and found[f"{name}.first"].verdict == "met"
    with index.opened(home / "runs") as known:
        assert len(known.runs("lab-bench")) == 3
    done.directory.rename(home / "gone")
    with index.opened(home / "runs") as known:
        assert known.runs("lab-bench") == []


def test_an_export_has_every_parts_maps_and_numbers(home):
    done = go(home / "runs")
    found = contents_of(done.directory)
    assert {"first/maps/correction.intensity_weight", "second/result/after/rms", "after/value"} <= set(found.quantities)
    assert "first/result.json" in found.documents
    assert set(found.images) == {"before", "after"} | {
        f"{part}/{name}" for part in ("first", "second") for name in ("maps", "before", "after")
    }


def test_a_part_that_leads_out_of_the_run_is_no_part(home):
    done = go(home / "runs")
    result = json.loads((done.directory / "result.json").read_text())
    for listed in (["../x", "/etc", 3, "nothing"], "first", None):
        (done.directory / "result.json").write_text(json.dumps({**result, "parts": listed}))
        with index.opened(home / "runs") as known:
            assert [Path(run.path) for run in known.runs("lab-bench")] == [done.directory]


def test_the_plan_is_that_of_all_stages_together(monkeypatch):
    facts = open_rig(load_rig("lab-bench", {})).facts()
    whole = procedure.All().plan(facts, procedure.Parameters())
    plans = [stage.plan(facts, procedure.Parameters().of(stage.name)) for stage in procedure.STAGES]
    assert whole.frames == sum(plan.frames for plan in plans)
    assert [stage.name for stage in procedure.STAGES] == ["response", "distortion", "aberration", "uniformity"]
    assert any(sentence.startswith("uniformity: ") for sentence in whole.sentences)


@pytest.mark.slow
def test_all_four_on_the_simulated_bench_meet_their_targets(tmp_path):
    from rigs.simulated.rig import SimulatedRig

    rig = SimulatedRig(load_rig("simulated-small", {}))
    record = RunRecord.create(tmp_path, "all", config="", identity=identity(rig.facts()))
    with record.open():
        done = run(
            procedure.All(), rig, procedure.Parameters(), seed=1, record=record, calibration={}, observer=Watcher(),
        )  # fmt: skip
    assert done.result["targets_met"] is True, done.sentence
    assert done.result["frames"] < 80
    assert done.result["truth"]["distortion"]["residual_px"]["rms"] < 0.15
    assert done.result["truth"]["response"]["phase_error_rms_rad"] < 0.02
