"""``holocal bench``: one small size, every number finite, and the page that is written."""

from __future__ import annotations

import json

import numpy as np
import pytest

from holocal.app.bench import measure
from holocal.app.bench.document import as_markdown
from holocal.app.bench.measure import Unit
from holocal.app.bench.run import parsed_size
from holocal.errors import UsageError


def test_a_benchmark_of_one_stage_writes_json_page_and_table(holocal, workplace):
    answer = holocal(
        "bench", "--stage", "propagation", "--size", "64x48", "--repeats", "1", "--out", "results", "--json"
    )
    assert answer.status == 0, answer.err
    rows = answer.json["rows"]
    assert {row["table"] for row in rows} == {"propagation"}
    errors = [row["relative_l2"] for row in rows if "relative_l2" in row]
    assert len(errors) >= 5
    assert max(errors) < 1e-5
    assert all(row["ratio_p"] > 0 for row in rows if "ratio_p" in row)
    assert json.loads((workplace / "results" / "benchmarks.json").read_text()) == answer.json
    page = (workplace / "results" / "benchmarks.md").read_text()
    assert "## Free space" in page
    assert answer.json["machine"]["processor"] in page


def test_the_ratio_is_the_median_of_each_run_over_the_pair_beside_it(monkeypatch):
    unit = Unit(16, 24)
    pairs, works = iter([1.0, 2.0, 4.0]), iter([5.0, 8.0, 12.0])
    monkeypatch.setattr(unit, "seconds", lambda: next(pairs))
    monkeypatch.setattr(measure, "_timed", lambda work: next(works))
    timing = unit.ratio(lambda: None, runs=3)
    assert timing.ratio == 4.0  # of 5, 4 and 3
    assert timing.seconds == 8.0
    assert timing.unit_seconds == 2.0


@pytest.mark.parametrize("text", ["", "3840", "axb", "0x5", "99999x9", "-3x4"])
def test_sizes_that_are_none_are_refused(text):
    with pytest.raises(UsageError):
        parsed_size(text)


def test_an_unknown_stage_is_refused(holocal):
    answer = holocal("bench", "--stage", "luck", "--json")
    assert answer.status == 2


def test_a_table_leaves_out_columns_that_nobody_fills():
    rows = [{"table": "encoders", "size": "4x4", "encoder": "one", "ratio_p": np.float64(2.5)}]
    page = as_markdown(rows, {"processor": "abacus"})
    assert "| size | encoder | P |" in page
    assert "| 4x4 | one | 2.5 |" in page
