"""The procedure `aberration` in mode `sweep`, whole, through the runner, on the simulated bench with a small panel."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from test_aberration import Watcher, tables

from holocal.errors import Interrupted, RefusedError
from holocal.loop.figures import read_figures
from holocal.loop.record import RunRecord
from holocal.loop.runner import run
from holocal.records import calibration
from holocal.records.rig import identity
from procedures._aberration_sweep_result import best_of
from procedures.aberration import Aberration, Parameters
from rigs.simulated.rig import SimulatedRig

STRAIGHT = {
    f"misalignment__{part}": [0.0, 0.0, 0.0]
    for part in ("mirror_rotation_deg", "mirror_shift_mm", "slm_rotation_deg", "slm_shift_mm")
}
RANGE = {"mode": "sweep", "zones": 3, "sweep_from_rad": -12.0, "sweep_to_rad": 12.0}


def go(slm_z_mm, directory, watcher=None, record=None, **chosen):
    rig = SimulatedRig(tables(**{**STRAIGHT, "misalignment__slm_shift_mm": [0.0, 0.0, slm_z_mm]}))
    record = record or RunRecord.create(directory, "aberration", config="", identity=dict(identity(rig.facts())))
    with record.open():
        return run(
            Aberration(), rig, Parameters(**{**RANGE, **chosen}), seed=1, record=record, calibration={},
            observer=watcher or Watcher(),
        )  # fmt: skip


@pytest.fixture(scope="module")
def near(tmp_path_factory):
    """A panel 2 mm nearer than it should be."""
    return go(2.0, tmp_path_factory.mktemp("runs"))


def test_a_sweep_finds_the_defocus_of_a_panel_that_is_shifted(near, tmp_path):
    far = go(-2.0, tmp_path)
    found = [done.result["sweep"] for done in (near, far)]
    assert all(done.result["frames"] == 12 for done in (near, far))
    assert all(sum(v is not None for v in one["best_rad"]) >= 7 for one in found)
    assert found[0]["median_rad"] < -3.0  # what undoes 2 mm, over the whole pupil
    assert found[1]["median_rad"] > 3.0
    assert found[0]["median_rad"] == pytest.approx(-found[1]["median_rad"], abs=1.5)
    assert 0 < found[0]["median_sigma_rad"] < 1.5


def test_each_zone_is_sharper_with_its_best_coefficient(near):
    result = near.result
    assert result["targets_met"]
    assert result["targets"] == {}
    assert result["after"]["median"]["sharpness"] > result["before"]["median"]["sharpness"] + 0.1
    assert result["after"]["median"]["sharpness"] == pytest.approx(1.0, abs=0.15)  # defocus is all that was wrong
    assert result["before"]["median"]["wavefront_rms_rad"] is None  # it was not measured
    assert set(result["before"]) == set(result["after"]) == {"median", "worst", "zones"}


def test_the_contact_sheet_has_a_row_per_coefficient_and_a_column_per_zone(near):
    sheet = next(figure for figure in read_figures(near.directory) if figure.kind == "sheet")
    picture, rows = sheet.arrays["sheet"], sheet.arrays["rows"]
    assert rows.tolist() == sorted(np.linspace(-12, 12, 9).tolist(), reverse=True)
    assert len(sheet.labels) == 9
    assert picture.shape == (9 * 25, 9 * 25)
    cells = picture.reshape(9, 25, 9, 25).transpose(0, 2, 1, 3)
    assert cells.max(axis=(0, 2, 3)) == pytest.approx(np.ones(9))  # one scale per zone
    assert np.all(cells.max(axis=(2, 3)) > 0.1)  # a spot in every cell
    assert np.all(np.median(cells, axis=(2, 3)) < 0.2)
    brightest = np.median(rows[cells.max(axis=(2, 3)).argmax(axis=0)])
    assert brightest == pytest.approx(near.result["sweep"]["median_rad"], abs=3.0)  # one row


def test_the_contact_sheet_is_drawn_and_is_not_blank(near):
    import base64

    import cv2

    from holocal.app.report.drawing import draw

    sheet = next(figure for figure in read_figures(near.directory) if figure.kind == "sheet")
    data = base64.b64decode(draw(sheet).split(",", 1)[1])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert min(image.shape) > 300
    assert np.mean(image < 60) > 0.3  # dark cells
    assert image[:, image.shape[1] // 4 :][: image.shape[0] // 2].std() > 20


def test_a_range_that_is_too_small_says_where_to_sweep(tmp_path):
    done = go(2.0, tmp_path, sweep_from_rad=-1.0, sweep_to_rad=1.0, sweep_steps=6)
    assert not done.result["targets_met"]
    assert done.exit_status == 3
    reasons = [zone["reason"] for zone in done.result["after"]["zones"] if not zone["valid"]]
    assert any("the end of the range" in reason for reason in reasons)


def test_a_sweep_is_never_put_in_force(near, tmp_path, monkeypatch):
    monkeypatch.setenv("HOLOCAL_HOME", str(tmp_path))
    with pytest.raises(RefusedError, match="corrects nothing"):
        calibration.accept(near.directory, identity(SimulatedRig(tables()).facts()))


def test_an_interrupted_sweep_ends_as_an_unbroken_one(near, tmp_path):
    rig = SimulatedRig(tables())
    record = RunRecord.create(tmp_path, "aberration", config="", identity=dict(identity(rig.facts())))
    with pytest.raises(Interrupted):
        go(2.0, tmp_path, record=record, watcher=Watcher(stop_at=1))
    done = go(2.0, tmp_path, record=RunRecord.reopen(record.directory))
    for key in ("before", "after", "sweep"):
        assert done.result[key] == near.result[key]


def test_the_best_coefficient_of_a_parabola_is_its_top_with_the_error_of_the_noise():
    x = np.linspace(-3, 3, 9)
    rng = np.random.default_rng(1)
    off, given = [], []
    for _ in range(200):
        best, sigma, reason = best_of(x, 1 - 0.05 * (x - 0.4) ** 2 + rng.normal(0, 0.01, 9))
        assert not reason
        off.append(best - 0.4)
        given.append(sigma)
    assert np.std(off) == pytest.approx(np.sqrt(np.mean(np.square(given))), rel=0.35)
    assert best_of(x, np.linspace(0.2, 0.9, 9))[2].startswith("it is sharpest at the end of the range, +3.00 rad")
    assert best_of(x, np.full(9, np.nan))[2] == "no light is seen where its spot should be"


def test_a_range_that_does_not_rise_is_a_wrong_parameter():
    with pytest.raises(ValidationError, match="sweep_from_rad 3 is not below sweep_to_rad -3"):
        Parameters(mode="sweep", sweep_from_rad=3.0, sweep_to_rad=-3.0)
