"""``holocal tolerance``: its files, the same numbers wherever they are made, cut off and gone on with, and refusals."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from holocal.app import tolerancing
from holocal.app.farm import Farm, gathered
from holocal.app.report.study import read_benches
from holocal.records.journal import Journal
from holocal.records.manifest import problems
from holocal.records.rig import load_rig
from holocal.records.tolerance_model import Study, Tolerances, read_tolerances
from holocal.tolerance.bench_error import METRICS, STAGES
from holocal.tolerance.cases import cases, drawn
from holocal.tolerance.design import design_of
from holocal.tolerance.summary import width_for

EXAMPLE = Path(__file__).parents[2] / "data_synthetic" / "tolerances.toml"
QUICK = ("--rig", "simulated-small", "--benches", "6", "--scaled", "3")


def made_up(piece):
    """Errors in proportion to the displacement, at once: light falls off, the rest grows."""
    size = float(np.linalg.norm(piece.case.freedoms))
    stages = {}
    for stage, share in zip(STAGES, (1.0, 0.1, 0.02), strict=True):
        stages[stage] = dict.fromkeys(METRICS, share * size)
        stages[stage]["light_fraction"] = stages[stage]["field_coverage"] = float(np.exp(-0.3 * share * size))
    more = ("corners_rms_px", "corners_max_px", "shift_px", "lit_share", "even_field", "nyquist_use", "beyond_nyquist")
    return {**stages, "more": dict.fromkeys(more, 0.1 * size) | {"field_lost": float("nan")}}


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(tolerancing, "trace", made_up)


def directory_of(answer) -> Path:
    return Path(answer.json["run"])


def test_a_study_writes_result_table_report_and_manifest(holocal, quick):
    answer = holocal("tolerance", EXAMPLE, *QUICK, "--json")
    assert answer.status in (0, 3), answer.err
    run = directory_of(answer)
    assert answer.status == (0 if answer.json["targets_met"] else 3)
    assert json.loads((run / "result.json").read_text()) == answer.json
    assert problems(run) == []
    page = (run / "report.html").read_text()
    assert page.count("<img") >= 4
    assert page.count("<img") == page.count('alt="')
    assert "http" not in page.replace("http://www.w3.org", "")
    table = read_benches(run / "benches.csv")
    assert len(table["bench"]) == 6
    tolerances = read_tolerances(EXAMPLE)
    np.testing.assert_allclose(table["slm_dz_mm"][3], drawn(tolerances, 0, 3)[11], rtol=1e-8)
    assert holocal("show", run).status == 0
    assert holocal("verify", run).status == 0
    assert holocal("report", run, "--out", "again.html").status == 0
    assert "field covered" in Path("again.html").read_text()


def test_a_study_that_was_cut_off_ends_as_one_that_was_not(holocal, quick):
    whole = directory_of(holocal("tolerance", *QUICK, "--json"))
    cut = directory_of(holocal("tolerance", *QUICK, "--json"))
    journal = cut / "benches.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:40]) + lines[40][:25])
    for name in ("manifest.json", "result.json", "benches.csv", "report.html"):
        (cut / name).unlink()
    answer = holocal("resume", cut, "--json")
    assert answer.status in (0, 3), answer.err
    assert f"40 of {len(lines)}" in answer.err
    assert (cut / "benches.csv").read_bytes() == (whole / "benches.csv").read_bytes()
    results = [json.loads((run / "result.json").read_text()) for run in (whole, cut)]
    for one in results:
        del one["run"], one["seconds"]
    assert results[0] == results[1]
    assert problems(cut) == []
    again = holocal("tolerance", "--resume", cut)
    assert again.status == 2
    assert "complete" in again.err


def test_real_benches_have_the_same_numbers_in_two_processes(tmp_path):
    study = Study(benches=3, scaled=1)
    design = design_of(load_rig("simulated-small").simulated, 515.0)
    chosen = [case for case in cases(study, 3) if case.key.startswith("bench/")]
    pieces = {case.key: tolerancing.Piece(design, case) for case in chosen}
    one = gathered(tolerancing.trace, pieces, Farm(), Journal(tmp_path / "one"))
    two = gathered(tolerancing.trace, pieces, Farm(workers=2), Journal(tmp_path / "two"))
    assert json.dumps(one) == json.dumps(two)
    assert len({line["before"]["distortion_rms_px"] for line in one.values()}) == 3


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[mirror]\nrotation_deg = [0.1, 0.1, -0.1]\nshift_mm = [0, 0, 0]", "mirror.rotation_deg"),
        ("[mirror]\nrotation_deg = [0.1, 0.1]\nshift_mm = [0, 0, 0]", "mirror.rotation_deg"),
        ("[slm]\nshift_mm = [0, 0, 0]", "slm.rotation_deg"),
        ("[spec]\nwavefront = 0.1", "spec.wavefront"),
        ('distribution = "flat"', "distribution"),
        ("wanted_yield = 1.5", "wanted_yield"),
        ("schema = 2", "schema"),
        ("[mirror", "TOML"),
    ],
)
def test_a_file_that_cannot_be_is_refused_with_its_key(holocal, workplace, text, key):
    (workplace / "wrong.toml").write_text(text)
    answer = holocal("tolerance", "wrong.toml", *QUICK, "--json")
    assert answer.status == 2
    assert key in answer.json["error"]["what"]
    assert "wrong.toml" in answer.json["error"]["what"]
    assert not (workplace / "runs").exists()


def test_refusals_of_options(holocal, workplace):
    assert holocal("tolerance", "--benches", "0").status == 2
    assert holocal("tolerance", "--set", "tolerance.mirror.rotation_deg=[0, 0, 99]", *QUICK).status == 2
    assert holocal("tolerance", "--rig", "loopback", "--dry-run").status == 2
    assert holocal("tolerance", "--workers", "2", "--scheduler", "tcp://127.0.0.1:1", *QUICK).status == 2
    assert holocal("tolerance", "absent.toml").status == 2


def test_a_dry_run_says_how_many_rays_benches_and_seconds_and_leaves_nothing(holocal, workplace):
    answer = holocal("tolerance", EXAMPLE, *QUICK, "--dry-run", "--json", "--set", "spec.light_fraction=0.4")
    assert answer.status == 0, answer.err
    assert answer.json["traces"] == 1 + 6 + 10 * 3 + 24 + 12 * 12
    assert answer.json["parameters"]["tolerances"]["spec"]["light_fraction"] == 0.4
    assert not (workplace / "runs").exists()


def test_a_bench_comes_from_the_seed_and_its_number_alone():
    some = Tolerances()
    np.testing.assert_array_equal(drawn(some, 4, 17), drawn(some, 4, 17))
    assert not np.array_equal(drawn(some, 4, 17), drawn(some, 5, 17))
    keys = [case.key for case in cases(Study(benches=9, scaled=4), 4)]
    assert len(set(keys)) == len(keys)
    longer = {case.key: case.freedoms for case in cases(Study(benches=30, scaled=4), 4)}
    assert all(longer[case.key] == case.freedoms for case in cases(Study(benches=9, scaled=4), 4))


def test_draws_have_the_spread_that_the_file_states():
    values = np.array([drawn(read_tolerances(EXAMPLE), 1, index) for index in range(4000)])
    np.testing.assert_allclose(values[:, 0].std(), 0.1, rtol=0.04)  # normal: 1 / sqrt(2 n) is 0.011
    assert np.abs(values[:, 6]).max() <= 0.15  # uniform
    np.testing.assert_allclose(values[:, 6].std(), 0.15 / np.sqrt(3), rtol=0.04)


@pytest.mark.parametrize("law", ["normal", "uniform"])
@pytest.mark.parametrize(("near", "far"), [(0.3, 0.3), (0.3, 0.5), (0.3, np.inf)])
def test_the_width_of_a_distribution_leaves_the_wanted_share_within_two_ends(law, near, far):
    width = width_for(near, far, law=law, share=0.9)
    rng = np.random.default_rng(0)
    value = width * (rng.standard_normal(200_000) if law == "normal" else rng.uniform(-1, 1, 200_000))
    assert np.mean((value > -near) & (value < far)) == pytest.approx(0.9, abs=0.003)


def test_a_correction_that_fails_is_said_to_fail_at_the_right_scale(holocal, quick):
    # the made-up wavefront after correction is 0.1 of the size: over 0.1 rad for displacements above 1
    answer = holocal(
        "tolerance", "--rig", "simulated-small", "--benches", "40", "--scaled", "40", "--json",
        "--set", "spec.wavefront_worst_rad=0.1", "--set", "spec.nonuniformity_rms=100",
        "--set", "spec.distortion_max_px=100",
    )  # fmt: skip
    sizes = [np.linalg.norm(drawn(Tolerances(), 0, index)) for index in range(40)]
    critical = answer.json["scale"]["after"]["critical"]
    np.testing.assert_allclose(critical, np.sort(1 / np.array(sizes)), rtol=1e-6)
    assert answer.json["scale"]["after"]["at_wanted_yield"] == pytest.approx(np.sort(1 / np.array(sizes))[2])
    assert set(answer.json["scale"]["after"]["first_missed"]) == {"wavefront left"}
    alone = answer.json["freedoms"]["mirror_rx_deg"]["allowed"]["after"]
    assert alone["positive"] == pytest.approx(1.0)
    assert alone["tolerance"] == pytest.approx(1 / 1.95996, rel=1e-4)


@pytest.mark.slow
def test_a_study_killed_in_two_processes_and_resumed_in_one_is_the_unbroken_one(holocal, workplace):
    (workplace / "one.toml").write_text(
        "[mirror]\nrotation_deg = [0.3, 0, 0]\nshift_mm = [0, 0, 0]\n"
        "[slm]\nrotation_deg = [0, 0, 0]\nshift_mm = [0, 0.5, 0]\n"
    )
    asked = ("tolerance", "one.toml", "--rig", "simulated-small", "--benches", "5", "--scaled", "1")
    whole = directory_of(holocal(*asked, "--json"))
    code = "import sys; from holocal.app.cli.main import invoke; sys.exit(invoke(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *asked, "--runs", "cut", "--workers", "2"]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 120
    while time.monotonic() < until and _lines(workplace / "cut") < 10:
        time.sleep(0.05)
    running.kill()
    running.wait()
    cut = next((workplace / "cut").iterdir())
    assert 10 <= _lines(workplace / "cut") < 1 + 5 + 10 + 24 + 24
    assert not (cut / "manifest.json").exists()
    answer = holocal("tolerance", "--resume", cut, "--json")
    assert answer.status in (0, 3), answer.err
    assert (cut / "benches.csv").read_bytes() == (whole / "benches.csv").read_bytes()
    assert problems(cut) == []


def _lines(runs: Path) -> int:
    return sum(path.read_bytes().count(b"\n") for path in runs.glob("*/benches.jsonl"))
