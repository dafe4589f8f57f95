"""Plans kept between programs are the plans that were made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from holocal.hologram.clock import Clock
from holocal.hologram.pipeline import HologramSettings
from holocal.hologram.scenes.points import PointCloud
from holocal.hologram.settings import Warped
from holocal.hologram.stored import from_arrays, plan_key, stored_plan, to_arrays
from holocal.hologram.synthesis import synthesise
from holocal.hologram.warp import Depth
from holocal.hologram.wavefront import Wavefront
from holocal.optics.bench import Bench, Panel, Pose
from holocal.records.cache import MOST_FILES, ArrayCache

DEG = np.pi / 180
SETTINGS = HologramSettings(Panel(480, 270, 3.74e-6), Bench(), 515e-9, (8 * DEG, 6 * DEG))


def test_a_plan_comes_back_from_its_arrays_to_the_last_bit():
    plan = stored_plan(SETTINGS, Depth(2.0, flat=True), (2, 1), None)
    arrays = to_arrays(plan)
    again = to_arrays(from_arrays({name: values.copy() for name, values in arrays.items()}))
    assert arrays.keys() == again.keys()
    assert all(np.array_equal(arrays[name], again[name]) for name in arrays)


def test_everything_a_plan_depends_on_has_its_own_key():
    bent = Wavefront((4,), ((0.1,),), (0.1, 0.1), 0, 515e-9)
    others = [
        (replace(SETTINGS, wavelength_m=516e-9), Depth(0.0), None),
        (replace(SETTINGS, gaze_rad=(1e-9, 0.0)), Depth(0.0), None),
        (replace(SETTINGS, bench=Bench(mirror=Pose((1e-9, 0.0, 0.0)))), Depth(0.0), None),
        (replace(SETTINGS, panel=Panel(481, 270, 3.74e-6)), Depth(0.0), None),
        (replace(SETTINGS, fov_rad=(8 * DEG, 7 * DEG)), Depth(0.0), None),
        (replace(SETTINGS, method=Warped(0.2)), Depth(0.0), None),
        (replace(SETTINGS, wavefront=bent), Depth(0.0), None),
        (SETTINGS, Depth(1.0), None),
        (SETTINGS, Depth(1.0, flat=True), None),
        (SETTINGS, Depth(0.0), (2, 2)),
    ]
    keys = {plan_key(*other) for other in [(SETTINGS, Depth(0.0), None), *others]}
    assert len(keys) == len(others) + 1
    assert plan_key(replace(SETTINGS, iterations=3, device="cuda"), Depth(0.0), None) in keys


def test_a_second_program_finds_the_plan_and_makes_the_same_hologram(tmp_path):
    tangents = np.stack(np.meshgrid([-0.03, 0.01, 0.02], [0.0, 0.015, -0.02]), axis=-1).reshape(-1, 2)
    cloud = PointCloud(tangents, np.full(9, np.inf), np.ones(9), np.zeros(9))
    fields = []
    for settings in (SETTINGS, replace(SETTINGS, gaze_rad=(0.0, 0.0))):
        found = synthesise([cloud], settings, reach=(99, 99), clock=Clock.start(), store=ArrayCache(tmp_path))
        fields.append(found.field.numpy().tobytes())
    assert len(list(tmp_path.iterdir())) == 2  # the panel's cut, and the plan of this depth in that cut
    assert fields[0] == fields[1]


def test_a_damaged_or_missing_file_is_made_again(tmp_path):
    cache = ArrayCache(tmp_path)
    assert cache.get("absent") is None
    cache.put("whole", {"a": np.arange(3.0)})
    assert np.array_equal(cache.get("whole")["a"], np.arange(3.0))
    path = tmp_path / "whole.npz"
    path.write_bytes(path.read_bytes()[:-40])
    assert cache.get("whole") is None
    path.write_bytes(b"no archive at all")
    assert cache.get("whole") is None


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(tmp_path):
    (tmp_path / "file").write_text("in the way")
    cache = ArrayCache(tmp_path / "file" / "cache")
    cache.put("key", {"a": np.zeros(2)})
    assert cache.get("key") is None


def test_the_oldest_files_go_when_there_are_too_many(tmp_path):
    cache = ArrayCache(tmp_path)
    for number in range(MOST_FILES + 5):
        cache.put(f"{number:04d}", {"a": np.zeros(1)})
    assert len(list(tmp_path.glob("*.npz"))) == MOST_FILES
    assert cache.get(f"{MOST_FILES + 4:04d}") is not None
