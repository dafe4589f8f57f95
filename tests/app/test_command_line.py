"""The command line's edges: help without heavy imports, usage errors, plug-ins, NO_COLOR."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("torch", "cv2", "matplotlib", "numpy", "scipy", "OpenImageIO", "skimage", "jinja2")


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from holocal.app.cli.main import invoke; status = invoke(['run', '--help']); "
        f"print([name for name in {HEAVY!r} if name in sys.modules], status, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip().endswith("[] 0")
    assert "--dry-run" in done.stdout


@pytest.mark.parametrize(
    "command",
    [
        "run",
        "resume",
        "accept",
        "check",
        "report",
        "show",
        "verify",
        "export",
        "history",
        "compare",
        "render",
        "capture",
        "detect-grid",
        "bench",
        "rigs",
        "procedures",
        "doctor",
    ],
)
def test_every_command_has_help(holocal, command):
    answer = holocal(command, "--help")
    assert answer.status == 0
    assert "Usage" in answer.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run",), "PROCEDURE"),
        (("run", "levelling", "--bla"), "--bla"),
        (("run", "levelin"), "levelling"),
        (("run", "levelling", "--rig", "lab-bensh"), "lab-bench"),
        (("run", "levelling", "--rig", "lab-bench", "--set", "steps"), "key.path=value"),
        (("run", "levelling", "--rig", "lab-bench", "--set", "stepps=3"), "steps"),
        (("run", "levelling", "--rig", "lab-bench", "--set", "steps=0"), "at least 1"),
        (("run", "levelling", "--rig", "lab-bench", "--device", "tpu"), "cpu, cuda"),
        (("resume", "nowhere"), "nowhere"),
        (("accept",), "RUN"),
        (("verify", "."), "manifest.json"),
        (("show", "."), "config.toml"),
    ],
)
def test_a_wrong_command_line_exits_2_and_says_what_to_do(holocal, arguments, said):
    plain = holocal(*arguments)
    assert plain.status == 2
    assert plain.out == ""
    assert said in plain.err
    assert "Traceback" not in plain.err
    as_json = holocal(*arguments, "--json")
    assert as_json.json["error"]["exit_status"] == 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('kind = "simulated"\n[slm]\npitch_um = -1\n', "slm.pitch_um = -1"),
        ('kind = "simulated"\n[slm]\npitchum = 3\n', "Did you mean pitch_um?"),
        ('kind = "simulated"\n[optics]\nwavelengths_nm = [0]\n', "at least 200"),
        ('kind = "simulated"\n[camera]\nk1 = nan\n', "finite"),
        ('kind = "simulated"\n[slm\n', "not a TOML file"),
        ("", "kind"),
        ('kind = "nothing-like-it"\n', "nothing-like-it"),
    ],
)
def test_a_wrong_rig_file_exits_2_naming_file_and_key(holocal, workplace, text, said):
    (workplace / "bench.toml").write_text(text)
    answer = holocal("run", "levelling", "--rig", "bench.toml", "--json")
    assert answer.status == 2
    assert said in answer.err
    if "nothing" not in said:
        assert "bench.toml" in answer.err


def test_a_broken_plug_in_is_listed_with_its_error_and_stops_nothing(holocal):
    listed = holocal("rigs", "--json")
    assert listed.status == 0
    kinds = {kind["name"]: kind["error"] for kind in listed.json["kinds"]}
    assert kinds["lab"] is None
    assert "no_such_module" in kinds["lab-broken"]
    names = {rig["name"] for rig in listed.json["rigs"]}
    assert {"simulated", "simulated-small", "simulated-ideal", "lab-bench"} <= names
    procedures = {item["name"] for item in holocal("procedures", "--json").json["procedures"]}
    assert {"levelling", "uniformity"} <= procedures


def test_the_doctor_finds_a_healthy_bench_and_a_frozen_panel(holocal):
    well = holocal("doctor", "--rig", "lab-bench", "--json")
    assert well.status == 0, well.err
    verdicts = {check["id"]: check["verdict"] for check in well.json["checks"]}
    assert {name for name, verdict in verdicts.items() if verdict != "pass"} == {"P04", "P05"}  # it has no read-back
    assert verdicts["P04"] == verdicts["P05"] == "unknown"
    ill = holocal("doctor", "--rig", "lab-bench", "--set", "faults.kind=frozen-panel", "--json")
    assert ill.status == 4
    assert "P10" in ill.json["error"]["what"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator is Linux's")
def test_the_allocator_is_told_to_give_memory_back():
    asked = "from holocal.app.memory import return_freed_memory; print(return_freed_memory())"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
