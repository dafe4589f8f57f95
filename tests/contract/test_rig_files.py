"""A rig's file: found, typed, refused with file, key, value and limit; its fingerprint."""

from __future__ import annotations

import pytest

from holocal.errors import ConfigError
from holocal.records.rig import built_in_rigs, fingerprint, load_rig


def test_the_built_in_rigs_are_the_thesis_bench_in_three_forms():
    assert {"simulated", "simulated-small", "simulated-ideal"} <= set(built_in_rigs())
    bench, small, ideal = (load_rig(f"simulated{form}").simulated for form in ("", "-small", "-ideal"))
    assert (bench.slm.width, bench.slm.height, bench.slm.pitch_um, bench.slm.bits) == (3840, 2160, 3.74, 8)
    assert bench.optics.wavelengths_nm == (473, 515, 639)
    assert (small.slm.width, small.slm.height) == (960, 540)
    assert small.misalignment == bench.misalignment and small.camera == bench.camera
    assert ideal.misalignment.mirror_rotation_deg == (0, 0, 0) and not ideal.camera.shot_noise


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("slm.pitch_um=-1", "slm.pitch_um = -1 is not greater than 0"),
        ("slm.pitch_um=0", "slm.pitch_um = 0 is not greater than 0"),
        ("slm.pitch_um=wide", "slm.pitch_um = 'wide'"),
        ("slm.width=0", "slm.width = 0 is not at least 1"),
        ("slm.width=16385", "at most 16384"),
        ("slm.width=960.0", "valid integer"),
        ("slm.fill_factor=0", "greater than 0"),
        ("slm.response=[0.0, 1.0]", "2 entries; 8 bits need 256"),
        ("slm.response=linear", "ideal"),
        ("optics.wavelengths_nm=[515, 0]", "0 is not at least 200"),
        ("optics.wavelengths_nm=[]", "wavelengths_nm"),
        ("misalignment.mirror_shift_mm=[0, 0]", "too few values"),
        ("camera.k1=nan", "finite"),
        ("camera.full_well_e=inf", "finite"),
        ("camera.shutter=1", "unknown key camera.shutter"),
        ("slm.pitchum=1", "Did you mean pitch_um?"),
        ("seed=-1", "seed = -1 is not at least 0"),
        ("slm=3", "slm"),
        ("slm.pitch_um", "key.path=value"),
        ("=3", "key.path=value"),
    ],
)
def test_an_impossible_value_is_refused_naming_its_key(override, said):
    with pytest.raises(ConfigError) as caught:
        load_rig("simulated", [override])
    assert said in str(caught.value)
    assert caught.value.fix or caught.value.why


def test_the_origin_of_each_value_is_known(tmp_path):
    (tmp_path / "bench.toml").write_text('kind = "simulated"\n[slm]\npitch_um = 8.0\n')
    rig = load_rig(str(tmp_path / "bench.toml"), ["camera.bits=10"])
    assert (rig.name, rig.simulated.slm.pitch_um, rig.simulated.camera.bits) == ("bench", 8.0, 10)
    assert rig.origins["slm.pitch_um"] == "bench.toml"
    assert rig.origins["camera.bits"] == "--set"
    assert rig.origins["slm.width"] == "default"


def test_the_fingerprint_knows_the_panel_and_not_what_is_unknown_of_the_bench():
    same = fingerprint(load_rig("simulated"))
    assert fingerprint(load_rig("simulated", ["misalignment.slm_shift_mm=[1.0, 0.0, 0.0]", "seed=9"])) == same
    assert fingerprint(load_rig("simulated", ["camera.read_noise_e=9.0"])) == same
    assert fingerprint(load_rig("simulated", ["slm.pitch_um=4.0"])) != same
    assert fingerprint(load_rig("simulated", ["camera.bits=10"])) != same


def test_a_rig_of_another_kind_passes_its_tables_to_its_plug_in():
    rig = load_rig("lab-bench", ["faults.kind=stale"])
    assert rig.kind == "lab" and rig.model is None
    assert rig.tables["faults"]["kind"] == "stale"
    with pytest.raises(ConfigError, match="not a simulated rig"):
        _ = rig.simulated


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"no\.toml cannot be read"):
        load_rig(str(tmp_path / "no.toml"))
