"""The pre-flight on a small bench made of arrays: each check passes on a good bench and fails on its own fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab_bench.rig import LabRig

from holocal.errors import RefusedError, SafetyStop
from holocal.loop.devices import Finding, Frame
from holocal.loop.lock import locked
from holocal.loop.preflight import Check, Expectations, preflight, refuse_failed
from holocal.loop.preflight.without_light import age_check, lock_check
from holocal.loop.procedure import Plan
from holocal.loop.shooting import Shooter
from holocal.records.rig import identity, load_rig

IDS = ["P01", "P02", "P03", "P04", "P05", "P06a", "P06b", "P06c", "P07a", "P07b", "P08", "P09", "P10", "P11a", "P11b",
       "P11c", "P12", "P14"]  # fmt: skip


def checked(
    tmp_path: Path,
    *,
    rig: LabRig | None = None,
    counts: Callable[[np.ndarray, LabRig], np.ndarray] | None = None,
    expected: Expectations | None = None,
    plan: Plan | None = None,
) -> tuple[dict[str, Check], LabRig]:
    """Return the checks by id of a bench whose counts go through a function, and the bench."""
    bench = rig or LabRig(load_rig("lab-bench"))
    plain = bench.camera.grab

    def grab() -> Frame:
        frame = plain()
        if counts is None:
            return frame
        changed = np.clip(np.rint(counts(frame.counts.astype(float), bench)), 0, 4095).astype(np.uint16)
        return replace(frame, counts=changed, saturated_fraction=float(np.mean(changed >= 4095)))

    bench.camera.grab = grab  # type: ignore[method-assign]
    shooter = Shooter(bench, bench.facts(), lambda *_: None)
    found = preflight(shooter, bench.facts(), plan, tmp_path, expected or Expectations())
    assert [check.id for check in found] == sorted(check.id for check in found)
    return {check.id: check for check in found}, bench


def failing(found: dict[str, Check]) -> set[str]:
    return {name for name, check in found.items() if check.verdict == "fail"}


def test_a_good_bench_passes_every_check_with_few_frames_of_two_patterns(tmp_path):
    bench = LabRig(load_rig("lab-bench"))
    shown = []
    show = bench.slm.show
    bench.slm.show = lambda levels: shown.append(levels.sum()) or show(levels)  # type: ignore[method-assign]
    found, _ = checked(tmp_path, rig=bench)
    assert list(found) == IDS
    assert failing(found) == set()
    assert {name for name, check in found.items() if check.verdict == "unknown"} == {"P01", "P04", "P05"}
    assert bench.camera.grabs <= 14
    assert len(shown) == 3 and shown[0] == shown[2] and shown[1] == 0  # of a 4K panel each picture takes 1.6 s
    refuse_failed(list(found.values()))


def test_the_bench_is_left_with_the_light_off_and_what_was_learnt_of_its_noise(tmp_path):
    bench = LabRig(load_rig("lab-bench"))
    shooter = Shooter(bench, bench.facts(), lambda *_: None)
    preflight(shooter, bench.facts(), None, tmp_path)
    assert shooter.reference is not None
    # read noise of 4 counts and rounding; no shot noise on this bench. 1200 pixels: 4 %
    assert shooter.reference.read_variance == pytest.approx(16 + 1 / 12, rel=0.12)
    assert shooter.reference.offset == pytest.approx(100.0, abs=0.5)


def gamma(value: float) -> Callable[[np.ndarray, LabRig], np.ndarray]:
    return lambda counts, _: 100 + 3995 * (np.clip(counts - 100, 0, None) / 3995) ** value


def automatic_exposure(counts: np.ndarray, bench: LabRig) -> np.ndarray:
    """Whatever is asked for, the picture is as bright as at 20 ms."""
    return 100 + (counts - 100) * 0.02 / bench.camera.exposure_s if bench.light.lit else counts


@pytest.mark.parametrize(
    ("counts", "ids"),
    [
        (gamma(0.9), {"P08"}),
        (gamma(1.1), {"P08"}),
        (automatic_exposure, {"P08"}),
        (gamma(1.0), set()),
        (lambda counts, bench: counts + 2000 * (not bench.light.lit), {"P06a"}),  # ambient light
        (lambda counts, _: 1000 + (counts - 100) * 60, {"P06b"}),
        (lambda counts, _: np.where(np.arange(40) % 10 == 0, 4000.0, counts), {"P06c"}),
        (lambda counts, _: counts - counts % 8, {"P07b"}),
        (lambda counts, bench: counts * (1 + 0.008 * bench.camera.grabs), {"P12"}),
    ],
)
def test_each_fault_of_the_camera_or_the_light_fails_its_own_check(tmp_path, counts, ids):
    found, bench = checked(tmp_path, counts=counts)
    assert failing(found) == ids
    assert all(found[name].remedy for name in ids)
    if {"P06a", "P06b", "P06c"} & ids:
        assert True not in bench.light.history  # refused before the light went on


def test_light_that_clips_at_the_shortest_exposure_is_a_safety_stop(tmp_path):
    bench = LabRig(load_rig("lab-bench", ["faults.kind=too-bright"]))
    bench._facts = replace(bench._facts, camera=replace(bench._facts.camera, exposure_min_s=0.02))
    with pytest.raises(SafetyStop):
        checked(tmp_path, rig=bench)


def test_a_procedure_that_stands_more_drift_is_not_refused_for_it(tmp_path):
    def drifting(counts: np.ndarray, bench: LabRig) -> np.ndarray:
        return counts * (1 + 0.008 * bench.camera.grabs)

    found, _ = checked(tmp_path, counts=drifting, plan=Plan(1, 1, 1.0, 0.1, tolerated_drift=0.2))
    assert found["P12"].verdict == "pass" and found["P12"].limit == 0.2
    assert isinstance(found["P12"].measured, float) and 0.03 < found["P12"].measured < 0.05  # five times 0.75 %


@pytest.mark.parametrize(("ok", "verdict"), [(True, "pass"), (False, "fail"), (None, "unknown")])
def test_what_a_device_says_of_itself_becomes_a_check(tmp_path, ok, verdict):
    bench = LabRig(load_rig("lab-bench"))
    finding = Finding("gamma ramp", "1.2", "identity", "", ok, "Reset it.")
    bench.slm.inspect = lambda: (finding,)  # type: ignore[attr-defined]
    found, _ = checked(tmp_path, rig=bench)
    assert found["P04"] == Check("P04", "SLM: gamma ramp", "1.2", "identity", "", verdict, "Reset it.")
    assert (True in bench.light.history) == (ok is not False)


def test_several_findings_of_one_device_are_all_named_in_the_refusal(tmp_path):
    bench = LabRig(load_rig("lab-bench"))
    findings = tuple(Finding(title, "on", "off", "", False, f"Switch {title} off.") for title in ("gain", "binning"))
    bench.camera.inspect = lambda: findings  # type: ignore[attr-defined]
    shooter = Shooter(bench, bench.facts(), lambda *_: None)
    with pytest.raises(RefusedError) as caught:
        refuse_failed(preflight(shooter, bench.facts(), None, tmp_path))
    assert caught.value.code == "P04"
    assert caught.value.measured == {"P04 camera: gain": "on", "P04 camera: binning": "on"}
    assert "Switch gain off. Switch binning off." in caught.value.fix


def test_a_camera_that_is_not_the_one_of_the_file_or_of_the_calibration_is_refused_by_field_and_values(tmp_path):
    mine = identity(LabRig(load_rig("lab-bench")).facts())
    same = Expectations(identity={"bench-a.toml": {"camera.serial": "CAM-1"}, "the accepted uniformity": mine})
    assert checked(tmp_path, expected=same)[0]["P03"].verdict == "pass"
    for source, values in (("bench-a.toml", {"camera.serial": "CAM-7"}), ("the accepted uniformity", None)):
        other = {source: values or {**mine, "camera.serial": "CAM-7"}}
        found, bench = checked(tmp_path, expected=Expectations(identity=other))
        check = found["P03"]
        assert check.verdict == "fail"
        assert check.measured == "camera.serial = 'CAM-1'" and check.limit == f"'CAM-7' ({source})"
        assert source in check.remedy
        assert True not in bench.light.history


def test_the_lock_names_its_owner(tmp_path):
    path = tmp_path / "lock"
    assert lock_check(None).verdict == lock_check(path).verdict == "unknown"
    with locked(path, "rig"):
        assert lock_check(path).verdict == "pass"
        path.write_text("process 1\n")
        assert (lock_check(path).verdict, lock_check(path).measured) == ("fail", "process 1")


@pytest.mark.parametrize(
    ("days", "limit", "verdict"), [(1, None, "pass"), (31, None, "warn"), (31, 40.0, "pass"), (8, 7.0, "fail")]
)
def test_an_old_calibration_is_a_warning_and_a_refusal_where_the_rig_says_so(days, limit, verdict):
    now = datetime(2026, 11, 22, tzinfo=UTC)
    measured = {"uniformity": now - timedelta(days=days), "aberration": now}
    check = age_check(Expectations(measured_utc=measured, max_age_days=limit), now)
    assert (check.verdict, check.measured, check.limit) == (verdict, float(days), limit or 30.0)
    assert "uniformity" in check.remedy


def test_a_calibration_of_unknown_age_is_neither_old_nor_young():
    assert age_check(Expectations(measured_utc={"uniformity": None})).verdict == "unknown"
    assert age_check(Expectations()).verdict == "pass"


def test_every_check_is_json_with_the_same_keys(tmp_path: Path):
    found, _ = checked(tmp_path)
    keys = {"id", "title", "measured", "limit", "unit", "verdict", "remedy"}
    said: list[dict[str, Any]] = [check.as_json() for check in found.values()]
    assert all(set(item) == keys for item in said)
    assert {item["verdict"] for item in said} <= {"pass", "warn", "fail", "unknown"}
