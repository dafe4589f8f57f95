"""``holocal render`` of a folder or of several scenes: the bytes of each alone, gone on with, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from holocal.app import batch

QUICK = ("--rig", "lab-bench", "--fov-deg", "6", "6", "--iterations", "2", "--corrections", "none")


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("HOLOCAL_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def folder(workplace) -> Path:
    (workplace / "scenes").mkdir()
    for k in range(3):
        image = np.zeros((20, 24), np.uint8)
        image[4 : 8 + k, 3 + k : 9] = 200
        cv2.imwrite(str(workplace / "scenes" / f"picture-{k}.png"), image)
    (workplace / "scenes" / "notes.txt").write_text("no scene")
    return workplace / "scenes"


def test_every_scene_of_a_folder_has_the_frame_that_it_has_alone(holocal, workplace, folder):
    answer = holocal("render", folder, "--out", "frames", *QUICK, "--json")
    assert answer.status == 0, answer.err
    assert [Path(one["file"]).name for one in answer.json["scenes"]] == [f"picture-{k}.png" for k in range(3)]
    for k in range(3):
        assert holocal("render", folder / f"picture-{k}.png", "--out", "alone.png", *QUICK).status == 0
        alone = (workplace / "alone.png").read_bytes()
        assert alone == (workplace / "frames" / f"picture-{k}.png").read_bytes()
    assert len({(workplace / "frames" / f"picture-{k}.png").read_bytes() for k in range(3)}) == 3


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(holocal, workplace, folder):
    assert holocal("render", folder, "--out", "one", *QUICK).status == 0
    answer = holocal("render", folder, "--out", "two", *QUICK, "--workers", "2")
    assert answer.status == 0, answer.err
    for path in sorted((workplace / "one").glob("*.png")):
        assert path.read_bytes() == (workplace / "two" / path.name).read_bytes()


def test_what_is_done_is_not_done_again_unless_it_changed(holocal, workplace, folder, monkeypatch):
    did = []
    whole = batch.rendered
    monkeypatch.setattr(batch, "rendered", lambda piece: did.append(piece.asked.scene.name) or whole(piece))

    def again(*options: str) -> list[str]:
        did.clear()
        answer = holocal("render", folder, "--out", "frames", *QUICK, *options, "--json")
        assert answer.status == 0, answer.err
        assert len(answer.json["scenes"]) == 3
        return list(did)

    names = [f"picture-{k}.png" for k in range(3)]
    assert again() == names
    assert again() == []
    (workplace / "frames" / names[0]).unlink()
    assert again() == names[:1]
    cv2.imwrite(str(folder / names[1]), np.full((20, 24), 90, np.uint8))
    assert again() == names[1:2]
    assert again("--seed", "1") == names
    journal = workplace / "frames" / "frames.jsonl"
    journal.write_bytes(journal.read_bytes()[:-7])
    assert len(again("--seed", "1")) == 1


def test_several_files_are_a_sequence(holocal, workplace, folder):
    answer = holocal("render", folder / "picture-2.png", folder / "picture-0.png", *QUICK, "--json")
    assert answer.status == 0, answer.err
    assert [Path(one["file"]).name for one in answer.json["scenes"]] == ["picture-2.png", "picture-0.png"]
    assert sorted(path.name for path in (workplace / "frames").glob("*.png")) == ["picture-0.png", "picture-2.png"]


def test_refusals(holocal, workplace, folder):
    (workplace / "empty").mkdir()
    assert holocal("render", "empty", *QUICK).status == 2
    assert holocal("render", folder, "--phase-out", "p.exr", *QUICK).status == 2
    (folder / "picture-1.csv").write_text("theta_x_deg,theta_y_deg,distance_m,intensity\n0,0,inf,1\n")
    answer = holocal("render", folder, *QUICK, "--json")
    assert answer.status == 2
    assert "picture-1.csv" in json.dumps(answer.json)
    assert not (workplace / "frames").exists()
