"""``holocal doctor``: everything that was found is told, and the exit status says whether it is well."""

from __future__ import annotations

from lab_bench.rig import LabRig

from holocal.loop.lock import locked
from holocal.records.calibration import rig_directory

DOCTOR = ("doctor", "--rig", "lab-bench")


def test_a_healthy_bench_exits_0_with_packages_devices_and_every_check(holocal):
    answer = holocal(*DOCTOR, "--json")
    assert answer.status == 0, answer.err
    told = answer.json
    assert told["healthy"] is True and "error" not in told
    assert told["packages"]["numpy"]
    assert len(told["checks"]) == 18
    assert all(
        {"id", "title", "measured", "limit", "unit", "verdict", "remedy"} == set(item) for item in told["checks"]
    )
    seen = {item["driver"]: item for item in told["devices"]}
    assert seen["lab"]["found"] == [
        {"model": "eye", "serial": "CAM-1"},
        {"model": "panel", "output": "HDMI-2", "width": "1920"},
    ]
    assert seen["lab-unplugged"]["found"] == [] and seen["lab-unplugged"]["error"] == "no network card"


def test_each_check_is_a_line_with_verdict_number_and_limit_and_what_to_do(holocal):
    lines = holocal(*DOCTOR).out.splitlines()
    noise = next(line for line in lines if "P06b" in line)
    assert noise.startswith("pass") and "(limit 0.05)" in noise and "of full scale" in noise
    unknown = next(number for number, line in enumerate(lines) if "P05" in line)
    assert lines[unknown].startswith("unknown") and "cannot be read back" in lines[unknown + 1]
    assert "seen by lab: model eye, serial CAM-1" in lines
    assert "lab-unplugged cannot look for devices: no network card" in lines


def test_broken_plug_ins_of_every_group_are_told_and_stop_nothing(holocal):
    answer = holocal(*DOCTOR, "--json")
    broken = {item["name"]: item for item in answer.json["broken_plugins"]}
    assert broken["lab-broken"]["group"] == "holocal.rigs"
    assert broken["lab-broken-camera"]["group"] == "holocal.cameras"
    assert "no_such_module" in broken["lab-broken-camera"]["error"]
    assert answer.status == 0


def test_a_check_that_fails_exits_4_with_all_of_them_and_the_remedy(holocal):
    answer = holocal(*DOCTOR, "--set", "faults.kind=frozen-panel", "--json")
    assert answer.status == 4
    told = answer.json
    assert told["healthy"] is False and told["error"]["code"] == "unhealthy"
    (failed,) = [item for item in told["checks"] if item["verdict"] == "fail"]
    assert failed["id"] == "P10" and failed["remedy"] in told["error"]["fix"]
    plain = holocal(*DOCTOR, "--set", "faults.kind=frozen-panel")
    assert plain.status == 4
    lines = plain.out.splitlines()
    at = next(number for number, line in enumerate(lines) if line.startswith("fail"))
    assert failed["remedy"] in lines[at + 1]
    assert "unhealthy" in plain.err


def test_a_rig_in_use_exits_75_and_names_who_has_it(holocal):
    lock = rig_directory("lab-bench") / "lock"
    with locked(lock, "rig lab-bench"):
        lock.write_text("process 4711\n")
        answer = holocal(*DOCTOR, "--json")
    assert answer.status == 75
    (check,) = answer.json["checks"]
    assert (check["id"], check["verdict"], check["measured"]) == ("P01", "fail", "process 4711")
    assert answer.json["packages"]["numpy"]


def test_a_device_that_is_lost_exits_6_and_what_else_was_found_is_told(holocal):
    answer = holocal(*DOCTOR, "--set", "faults.kind=unplugged", "--set", "faults.at=4", "--json")
    assert answer.status == 6
    assert answer.json["error"]["code"] == "device-lost"
    assert answer.json["devices"] and answer.json["packages"]["numpy"]


def test_light_that_is_too_bright_exits_5(holocal):
    assert holocal(*DOCTOR, "--set", "faults.kind=too-bright", "--json").status == 5


def test_without_the_pre_flight_no_device_is_touched(holocal, monkeypatch):
    def touched(*_: object) -> None:
        raise AssertionError("a device was opened")

    monkeypatch.setattr(LabRig, "__init__", touched)
    answer = holocal(*DOCTOR, "--no-preflight", "--json")
    assert answer.status == 0
    assert answer.json["checks"] == [] and answer.json["devices"] == []
