"""``holocal detect-grid``: the JSON, the sentence, the overlay, and what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from dot_pictures import Target, picture

TARGET = Target(width=400, height=300, rotation=6, k1=-0.1)


@pytest.fixture
def photograph(workplace):
    seen = picture(TARGET)
    cv2.imwrite(str(workplace / "target.png"), np.rint(255 * seen.image).astype(np.uint8))
    return seen


def test_the_json_holds_every_dot_with_its_cell(holocal, photograph):
    answer = holocal("detect-grid", "target.png", "--json")
    assert answer.status == 0, answer.err
    said = answer.json
    assert said["schema"] == 1
    assert said["found"] >= said["indexed"] == len(said["points"]) >= 0.98 * len(photograph.centre)
    assert said["rows"] == 1 + max(point["row"] for point in said["points"])
    assert said["columns"] == 1 + max(point["column"] for point in said["points"])
    assert 0 < said["holdout_rms_px"] < 0.05
    assert said["outliers"] <= 0.05 * said["indexed"]
    for point in said["points"][::10]:
        assert set(point) == {"row", "column", "x", "y", "sigma_px"}
        # Of dots within a pixel of the picture's edge the truth does not say whether they are whole.
        near_the_edge = min(point["x"], point["y"], TARGET.width - 1 - point["x"], TARGET.height - 1 - point["y"]) < 8
        distance = np.hypot(*(photograph.centre - [point["x"], point["y"]]).T)
        assert distance.min() < 5 * point["sigma_px"] + 0.02 or near_the_edge


def test_without_json_a_sentence_says_it(holocal, photograph):
    answer = holocal("detect-grid", "target.png")
    assert answer.status == 0
    assert answer.out.count("\n") == 1
    assert "rows" in answer.out
    assert "columns" in answer.out
    assert "px" in answer.out


def test_the_overlay_is_the_picture_with_lines(holocal, workplace, photograph):
    answer = holocal("detect-grid", "target.png", "--overlay", "seen.png", "--json")
    assert answer.status == 0, answer.err
    drawn = cv2.imread(str(workplace / "seen.png")).astype(int)
    assert drawn.shape[0] % TARGET.height == 0
    assert drawn.shape[0] * TARGET.width == drawn.shape[1] * TARGET.height
    coloured = np.ptp(drawn, axis=2) > 60
    assert 0.01 < coloured.mean() < 0.5


def test_colour_and_sixteen_bits_are_read(holocal, workplace, photograph):
    levels = np.rint(65535 * np.clip(photograph.image, 0, 1)).astype(np.uint16)
    cv2.imwrite(str(workplace / "target.tif"), np.stack([levels] * 3, axis=-1))
    plain, deep = (holocal("detect-grid", name, "--json").json for name in ("target.png", "target.tif"))
    assert deep["indexed"] == plain["indexed"]


def test_a_picture_without_a_grid_is_refused_with_status_4(holocal, workplace):
    noise = np.random.default_rng(0).integers(0, 256, (200, 300)).astype(np.uint8)
    cv2.imwrite(str(workplace / "noise.png"), noise)
    answer = holocal("detect-grid", "noise.png", "--overlay", "seen.png", "--json")
    assert answer.status == 4
    assert answer.json["error"]["code"] == "no-grid"
    assert "Traceback" not in answer.err
    assert not (workplace / "seen.png").exists()
    cv2.imwrite(str(workplace / "black.png"), np.zeros((200, 300), np.uint8))
    assert holocal("detect-grid", "black.png").status == 4


@pytest.mark.parametrize(
    ("name", "data"),
    [("absent.png", None), ("empty.png", b""), ("cut.png", b"\x89PNG\r\n\x1a\n"), ("words.jpg", b"hello")],
)
def test_a_file_that_is_no_picture_is_an_input_error(holocal, workplace, name, data):
    if data is not None:
        (workplace / name).write_bytes(data)
    answer = holocal("detect-grid", name, "--json")
    assert answer.status == 2
    assert name in answer.json["error"]["what"]


def test_an_overlay_that_cannot_be_written_is_refused_before_the_work(holocal, photograph):
    assert "does not end in .png" in holocal("detect-grid", "target.png", "--overlay", "seen.jpg").err
    answer = holocal("detect-grid", "target.png", "--overlay", "nowhere/seen.png", "--json")
    assert answer.status == 2
    assert "nowhere" in answer.json["error"]["what"]
