"""``holocal export``: names, units and axes survive; a damaged run is refused; nothing is left half written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813 - its usual name
import pytest

from holocal.app import session
from holocal.app.export.contents import Quantity, contents_of
from holocal.records.maps import Maps, read_maps, write_parts
from holocal.units import DEGREE


@pytest.fixture(autouse=True)
def no_drawing(monkeypatch):
    monkeypatch.setattr(session, "render_report", lambda directory: b"<!doctype html>")


@pytest.fixture
def run(holocal) -> Path:
    return Path(holocal("run", "levelling", "--rig", "lab-bench", "--json").json["run"])


def test_numpy_arrays_come_back_with_units_and_axes_and_without_pickle(holocal, workplace, run):
    answer = holocal("export", run, "--json")
    assert answer.status == 0, answer.err
    assert answer.json["file"] == f"{run.name}.npz"
    with np.load(workplace / answer.json["file"], allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    index = json.loads(str(arrays["index.json"]))
    maps, result = read_maps(run / "maps.exr"), json.loads((run / "result.json").read_text())
    np.testing.assert_array_equal(arrays["maps/valid"], maps.channels["valid"])
    assert index["quantities"]["maps/valid"]["axes"] == ["maps/y_deg", "maps/x_deg"]
    assert index["quantities"]["maps/x_deg"]["unit"] == "deg"
    assert arrays["result/after/spread"] == result["after"]["spread"]
    assert json.loads(str(arrays["documents/result.json"])) == result
    assert [str(text) for text in arrays["steps/quantity"]] == ["spread of the means"] * 3
    assert index["run"] == run.name and index["targets_met"] is True


def test_pixel_centres_are_even_in_tangents_row_0_on_top(run):
    found = contents_of(run).quantities
    height, width = found["maps/valid"].values.shape
    x, y = (np.tan(found[f"maps/{axis}_deg"].values * DEGREE) for axis in "xy")
    assert x.shape == (width,) and y.shape == (height,)
    np.testing.assert_allclose(np.diff(x), 2 * np.tan(12.5 * DEGREE) / width, rtol=1e-9)
    np.testing.assert_allclose(np.diff(y), -2 * np.tan(10.0 * DEGREE) / height, rtol=1e-9)
    assert x[0] < 0 < y[0]


def test_hdf5_has_units_as_attributes_and_axes_as_scales(holocal, workplace, run):
    import h5py

    assert holocal("export", run, "--out", "run.h5").status == 0
    with h5py.File(workplace / "run.h5") as file:
        valid = file["maps/valid"]
        assert [dimension.label for dimension in valid.dims] == ["y_deg", "x_deg"]
        assert valid.dims[1][0] == file["maps/x_deg"]
        assert file["maps/x_deg"].attrs["unit"] == "deg"
        assert file["result/targets/spread"][()] == 0.5
        assert file.attrs["procedure"] == "levelling"
        assert json.loads(file["documents/result.json"][()])["run"] == str(run)


def test_hdf5_without_its_package_is_refused_with_the_command_that_installs_it(holocal, workplace, run, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    answer = holocal("export", run, "--format", "hdf5", "--json")
    assert answer.status == 2
    assert "holocal[hdf5]" in answer.json["error"]["fix"]
    assert not list(workplace.glob("*.h5"))


def test_openexr_has_a_part_per_image_and_the_numbers_as_metadata(holocal, workplace, run):
    assert holocal("export", run, "--format", "exr").status == 0
    source = oiio.ImageInput.open(str(workplace / f"{run.name}.exr"))
    names, number = [], 0
    while source.seek_subimage(number, 0):
        names.append(source.spec()["oiio:subimagename"])
        number += 1
    source.close()
    assert names == ["maps", "before", "after"]
    first = read_maps(workplace / f"{run.name}.exr")
    assert first.metadata["about"]["run"] == run.name
    assert json.loads(first.metadata["documents"]["result.json"])["procedure"] == "levelling"


def test_parts_of_different_shapes_keep_their_pixels(tmp_path):
    rng = np.random.default_rng(3)
    parts = {
        "wide": Maps({"b": rng.normal(size=(2, 9)).astype(np.float32), "a": np.ones((2, 9), np.float32)}),
        "tall": Maps({"value": rng.normal(size=(11, 3)).astype(np.float32)}),
    }
    write_parts(tmp_path / "parts.exr", parts)
    source = oiio.ImageInput.open(str(tmp_path / "parts.exr"))
    for number, part in enumerate(parts.values()):
        assert source.seek_subimage(number, 0)
        pixels = source.read_image(number, 0, 0, source.spec().nchannels, oiio.FLOAT).reshape(
            source.spec().height, source.spec().width, -1
        )
        for i, name in enumerate(source.spec().channelnames):
            np.testing.assert_array_equal(pixels[..., i], part.channels[name])
    source.close()


def test_tables_are_columns_and_unknown_numbers_are_nan():
    from holocal.app.export.contents import _of_tree

    zones = [{"rms_rad": 0.1, "noll": {"4": 1.0}, "why": ""}, {"rms_rad": None, "noll": {"4": 2.0}, "why": "dark"}]
    found = _of_tree({"zones": zones, "ragged": [[1], [2, 3]], "mode": "model"}, "after")
    assert set(found) == {"after/zones/rms_rad", "after/zones/noll/4", "after/zones/why"}
    assert isinstance(found["after/zones/rms_rad"], Quantity) and found["after/zones/rms_rad"].unit == "rad"
    np.testing.assert_array_equal(found["after/zones/rms_rad"].values, [0.1, np.nan])


def _changed(run: Path) -> None:
    with (run / "result.json").open("a") as file:
        file.write(" ")


def _linked(run: Path) -> None:
    outside = run.parent / "outside.json"
    (run / "result.json").rename(outside)
    (run / "result.json").symlink_to(outside)


def _of_another(run: Path) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["files"]["../../secret"] = {"sha256": "", "bytes": 0}
    (run / "manifest.json").write_text(json.dumps(manifest))


DAMAGE = {
    "changed": (_changed, "result.json has"),
    "missing": (lambda run: (run / "maps.exr").unlink(), "maps.exr is missing"),
    "a link": (_linked, "symbolic link"),
    "outside": (_of_another, "outside"),
    "no manifest": (lambda run: (run / "manifest.json").unlink(), "has no manifest.json"),
    "torn": (lambda run: (run / "manifest.json").write_text('{"schema": 1, "fi'), "not a JSON file"),
    "endless": (lambda run: (run / "manifest.json").write_text("[" * 100_000), "not a JSON file"),
    "no list": (lambda run: (run / "manifest.json").write_text('{"schema": 1, "files": [1]}'), "lists no files"),
    "no directory": (lambda run: run.rename(f"{run}-gone"), "does not exist"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_run_is_refused_and_nothing_is_written(holocal, workplace, run, kind):
    damage, said = DAMAGE[kind]
    damage(run)
    for command in ("export", "verify", "accept"):
        answer = holocal(command, run, "--json")
        assert answer.status == 2, (command, answer.err)
        assert answer.json["error"]["exit_status"] == 2
        assert "Traceback" not in answer.err
        if kind != "no directory" or command != "accept":
            assert said in answer.json["error"]["what"]
    assert not list(workplace.glob("*.npz"))


def test_a_run_without_a_result_is_refused(holocal, workplace):
    holocal("run", "levelling", "--rig", "lab-bench", "--set", "rig.faults.kind=unplugged")
    (run,) = (workplace / "runs").iterdir()
    answer = holocal("export", run, "--json")
    assert answer.status == 2
    assert answer.json["error"]["code"] == "no-result"


def test_a_run_is_never_exported_into_itself(holocal, run):
    assert holocal("export", run, "--out", run / "more.npz").status == 2
    assert holocal("verify", run).status == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--format", "csv"), "npz, hdf5, exr"),
        (("--out", "run.txt"), "give --format"),
        (("--format", "exr", "--out", "run.tif"), ".exr"),
        (("--out", "nowhere/run.npz"), "does not exist"),
    ],
)
def test_a_wrong_format_or_place_exits_2(holocal, run, options, said):
    answer = holocal("export", run, *options, "--json")
    assert answer.status == 2
    assert said in answer.json["error"]["what"]
