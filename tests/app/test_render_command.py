"""``holocal render``: every kind of scene, colour, methods and encoders, what is skipped, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from holocal.records.maps import read_maps

EXAMPLES = Path(__file__).parents[2] / "data_synthetic"
QUICK = ("--rig", "lab-bench", "--fov-deg", "6", "6", "--iterations", "2")


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("HOLOCAL_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def picture(workplace):
    image = np.zeros((20, 24, 3), np.uint8)
    image[5:12, 3:9, 2] = 200  # red: OpenCV writes blue first
    cv2.imwrite(str(workplace / "red.png"), image)
    return "red.png"


@pytest.mark.parametrize(
    ("name", "kind"),
    [("points.csv", "points"), ("layers.toml", "layers"), ("light_field.toml", "light field"), ("mesh.obj", "mesh")],
)
def test_every_kind_of_scene_becomes_a_frame(holocal, workplace, name, kind):
    answer = holocal("render", EXAMPLES / name, "--out", "frame.png", *QUICK, "--pixels", "40", "30", "--json")
    assert answer.status == 0, answer.err
    assert answer.json["scene"] == kind
    frame = cv2.imread(str(workplace / "frame.png"))
    assert frame.shape == (answer.json["height"], answer.json["width"], 3)
    assert len(np.unique(frame[..., 2])) > 50
    assert answer.json["points"] > 0


def test_the_seconds_of_every_stage_are_listed(holocal, picture):
    answer = holocal("render", picture, *QUICK, "--json")
    assert set(answer.json["seconds"]) >= {"read", "scene", "table", "synthesis", "encode", "levels", "write"}
    assert sum(answer.json["seconds"].values()) <= answer.json["total_seconds"]
    assert any("points: dark" in sentence for sentence in answer.json["skipped"])


def test_a_colour_without_light_gets_no_frame_and_says_so(holocal, workplace, picture):
    answer = holocal("render", picture, "--colour", *QUICK, "--out", "frame.png", "--json")
    assert answer.status == 0, answer.err
    frames = {line["wavelength_nm"]: line["frame"] for line in answer.json["frames"]}
    made = [wavelength for wavelength, frame in frames.items() if frame]
    assert made == [wavelength for wavelength in frames if wavelength >= 580]
    assert all((workplace / frames[wavelength]).is_file() for wavelength in made)
    assert not (workplace / "frame.png").exists()
    dark = [wavelength for wavelength in frames if wavelength not in made]
    for wavelength in dark:
        assert any(f"{wavelength:g} nm: the wavelength: no light" in said for said in answer.json["skipped"])


def test_a_black_scene_is_a_uniform_frame_at_once(holocal, workplace):
    cv2.imwrite(str(workplace / "black.png"), np.zeros((9, 9), np.uint8))
    answer = holocal("render", "black.png", *QUICK, "--json")
    assert answer.status == 0, answer.err
    assert any("uniform" in sentence for sentence in answer.json["skipped"])
    assert "synthesis" not in answer.json["seconds"]
    assert not cv2.imread(str(workplace / "frame.png")).any()


@pytest.mark.parametrize("encoder", ["gradient-descent", "direct-search", "error-diffusion", "double-phase"])
def test_every_encoder_makes_a_frame_of_its_own(holocal, workplace, picture, encoder):
    frames = []
    for chosen in (encoder, "ifta"):
        answer = holocal("render", picture, *QUICK, "--encoder", chosen, "--json")
        assert answer.status == 0, answer.err
        frames.append(cv2.imread(str(workplace / "frame.png")))
    assert np.any(frames[0] != frames[1])


def test_the_methods_agree_on_the_full_complex_hologram(holocal, workplace):
    (workplace / "points.csv").write_text(
        "theta_x_deg, theta_y_deg, distance_m, intensity\n"
        + "".join(f"{0.3 * i - 1}, {0.2 * i - 0.5}, inf, 1\n" for i in range(7))
    )
    fields = {}
    for method in ("warped", "direct"):
        arguments = ("--method", method, "--complex-out", "field.exr", "--json")
        answer = holocal("render", "points.csv", *QUICK, *arguments)
        assert answer.status == 0, answer.err
        maps = read_maps(workplace / "field.exr").channels
        fields[method] = maps["real"] + 1j * maps["imag"]
    error = np.linalg.norm(fields["warped"] - fields["direct"]) / np.linalg.norm(fields["direct"])
    assert error < 0.1  # the default accuracy


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--encoder", "magic"), "--encoder magic"),
        (("--method", "magic"), "--method magic"),
        (("--initial-phase", "magic"), "--initial-phase magic"),
        (("--accuracy", "0"), "--accuracy 0"),
        (("--method", "direct", "--zones", "3"), "it does not go with --method direct"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_choices_that_do_not_exist_are_refused_by_name(holocal, picture, arguments, said):
    answer = holocal("render", picture, *QUICK, *arguments, "--json")
    assert answer.status == 2
    assert said in json.dumps(answer.json)


def test_a_file_that_is_no_scene_is_refused_with_the_kinds_that_are(holocal, workplace):
    (workplace / "scene.blend").write_bytes(b"x")
    answer = holocal("render", "scene.blend", *QUICK, "--json")
    assert answer.status == 2
    assert ".obj" in answer.json["error"]["fix"]
