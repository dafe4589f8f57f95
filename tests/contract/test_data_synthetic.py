"""The synthetic captures are what their manifest says, can be made again, and hold the truth that they claim."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from holocal.estimate.blocks import block_means
from holocal.estimate.brightness import fit_brightness
from holocal.estimate.thesis_map import at_size, thesis_map
from holocal.records.files import sha256_of
from holocal.records.frames import read_counts

DATA = Path(__file__).parents[2] / "data_synthetic"


@pytest.fixture(scope="module")
def maker():
    spec = importlib.util.spec_from_file_location("data_synthetic_make", DATA / "make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pictures():
    dark = read_counts(DATA / "dark.png").astype(float)
    return np.stack([read_counts(DATA / f"white-{i}.png") - dark for i in (0, 1)])


def test_every_file_has_the_bytes_that_the_manifest_lists_and_none_is_unlisted():
    manifest = json.loads((DATA / "manifest.json").read_text())
    files = {path.name for path in DATA.iterdir() if path.is_file()} - {"make.py", "README.md", "manifest.json"}
    assert files == set(manifest)
    for name, entry in manifest.items():
        assert (sha256_of(DATA / name), (DATA / name).stat().st_size) == (entry["sha256"], entry["bytes"])
    assert sum(entry["bytes"] for entry in manifest.values()) < 2e6


def test_making_them_again_gives_the_same_pixels_and_truth(maker, tmp_path):
    maker.make(tmp_path)
    assert maker.differences(DATA, tmp_path) == []


def test_a_changed_pixel_is_told(maker, tmp_path):
    maker.make(tmp_path)
    pixels = maker.cv2.imread(str(tmp_path / "dark.png"), maker.cv2.IMREAD_UNCHANGED)
    pixels[7, 9] += 1
    maker.cv2.imwrite(str(tmp_path / "dark.png"), pixels)
    assert maker.differences(DATA, tmp_path) == ["dark.png"]


def test_both_estimators_find_the_true_brightness_and_the_fit_is_nearer(pictures):
    truth = np.load(DATA / "truth.npy").astype(float)
    assert truth.max() == pytest.approx(1.0) and truth.min() == pytest.approx(0.25, rel=1e-3)
    blocks = block_means(pictures, 15)
    found, _ = fit_brightness(blocks, np.zeros((2, 20, 20)), shown=np.ones((300, 300), bool), block_px=15, floor=0.3)
    thesis = at_size(thesis_map(pictures.mean(axis=0)), 300, 300)
    left = {}
    for name, estimate in (("fit", found.brightness), ("thesis", thesis)):
        ratio = (estimate / truth)[found.valid]
        left[name] = float(ratio.std() / ratio.mean())
    assert found.valid.mean() > 0.5
    assert left["fit"] < 0.02  # 2 frames of 3.5 % per block, some 20 independent places in 400 blocks: 1 %, and room
    assert left["thesis"] < 0.04  # the grain of a block that a Gaussian of one block leaves, 1 to 2 %, and its borders
    assert left["fit"] < left["thesis"]


def test_the_blobs_are_seen_shifted_as_the_truth_says():
    truth = json.loads((DATA / "truth.json").read_text())
    seen = read_counts(DATA / "blobs-shifted.png") - read_counts(DATA / "dark.png").astype(float)
    errors = []
    for column, row in np.array(truth["blob_places_px"]) + truth["shift_px"]:
        c, r = round(column), round(row)
        if not (8 <= c < 292 and 8 <= r < 292):
            continue
        window = np.maximum(seen[r - 7 : r + 8, c - 7 : c + 8] - 10, 0)  # 3.5 times the noise of a difference
        y, x = np.mgrid[r - 7 : r + 8, c - 7 : c + 8]
        errors.append(((window * x).sum() / window.sum() - column, (window * y).sum() / window.sum() - row))
    assert len(errors) > 60
    np.testing.assert_allclose(np.mean(errors, axis=0), 0, atol=0.15)  # 60 centroids good to some 0.3 px each
