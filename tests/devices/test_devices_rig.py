"""A bench put together from drivers: order, half-opened benches, limits, identity, errors that name file and key."""

from __future__ import annotations

from pathlib import Path

import lab_drivers
import pytest

from holocal.app.session import opened_rig
from holocal.errors import ConfigError, DeviceError, RefusedError, SafetyStop
from holocal.loop.devices import Camera, Inspectable, Light, Rig, Slm
from holocal.records.rig import RigConfig, identity, load_rig
from rigs.devices import open_rig

FILE = """
kind = "devices"
[slm]
driver = "lab"
[camera]
driver = "lab"
[light]
driver = "lab"
[optics]
wavelengths_nm = [473, 515]
pupil_mm = 3.0
[safety]
max_exposure_s = 0.5
"""


@pytest.fixture(autouse=True)
def history() -> list[str]:
    lab_drivers.HISTORY.clear()
    lab_drivers.CONTEXTS.clear()
    return lab_drivers.HISTORY


def bench(folder: Path, *overrides: str, text: str = FILE) -> RigConfig:
    (folder / "bench-a.toml").write_text(text)
    return load_rig(str(folder / "bench-a.toml"), overrides)


def test_a_labs_three_drivers_make_a_rig_that_opens_dark_and_closes_dark(tmp_path, history):
    config = bench(tmp_path)
    with opened_rig(config) as rig:
        assert isinstance(rig, Rig)
        assert isinstance(rig.slm, Slm) and isinstance(rig.camera, Camera) and isinstance(rig.light, Light)
        assert history == ["light.open", "light.off", "slm.open", "slm.blank", "camera.open"]
        assert rig.truth() is None
        history.clear()
    assert history == ["light.off", "camera.close", "slm.blank", "slm.close", "light.off", "light.close"]
    rig.close()  # twice
    assert len(history) == 6
    assert {(context.rig, context.source) for context in lab_drivers.CONTEXTS} == {("bench-a", config.source)}
    assert lab_drivers.CONTEXTS[0].wavelengths_m == pytest.approx((473e-9, 515e-9))


@pytest.mark.parametrize(
    ("fault", "closed"),
    [
        ("slm.fails=open", ["light.off", "light.close"]),
        ("slm.fails=blank", ["slm.blank", "slm.close", "light.off", "light.close"]),
        ("camera.fails=open", ["slm.blank", "slm.close", "light.off", "light.close"]),
    ],
)
def test_a_bench_that_opens_by_half_is_closed_again_with_the_light_off_and_the_panel_blank(
    tmp_path, history, fault, closed
):
    with pytest.raises(DeviceError, match="failed at"):
        open_rig(bench(tmp_path, fault))
    assert history[-len(closed) :] == closed


def test_a_device_that_cannot_be_closed_does_not_keep_the_others_open(tmp_path, history):
    rig = open_rig(bench(tmp_path, "camera.fails=close", "slm.fails=close"))
    history.clear()
    rig.close()
    assert history == ["light.off", "camera.close", "slm.blank", "slm.close", "light.off", "light.close"]


def test_a_light_that_cannot_be_switched_off_is_said_and_everything_else_is_closed(tmp_path, history):
    rig = open_rig(bench(tmp_path))
    rig.light.table = {"fails": "off"}  # type: ignore[attr-defined]
    with pytest.raises(DeviceError, match="the light failed at off"):
        rig.close()
    assert history[-5:] == ["camera.close", "slm.blank", "slm.close", "light.off", "light.close"]


def test_the_longest_exposure_is_the_rigs_whatever_the_camera_can_do(tmp_path):
    rig = open_rig(bench(tmp_path))
    assert rig.facts().camera.exposure_max_s == rig.camera.describe().exposure_max_s == 0.5
    assert rig.camera.set_exposure(0.5) == 0.5
    with pytest.raises(SafetyStop, match=r"0\.6 s was asked for; safety\.max_exposure_s allows 0\.5 s"):
        rig.camera.set_exposure(0.6)
    with pytest.raises(SafetyStop):
        rig.camera.set_exposure(float("nan"))
    rig.close()
    rig = open_rig(bench(tmp_path, "camera.rounds_up=1.5"))
    with pytest.raises(SafetyStop, match=r"0\.75 s is what the camera made of it"):
        rig.camera.set_exposure(0.5)
    assert isinstance(rig.camera, Inspectable) and rig.camera.inspect()[0].title == "gamma"
    rig.close()


def test_another_device_than_the_one_that_is_named_is_refused(tmp_path, history):
    open_rig(bench(tmp_path, "camera.serial=C-1", "slm.serial=P-1")).close()
    for table, serial in (("camera", "C-1"), ("slm", "P-1")):
        with pytest.raises(RefusedError) as caught:
            open_rig(bench(tmp_path, f"{table}.serial=X-9"))
        assert f"{table}.serial = 'X-9'" in str(caught.value) and serial in str(caught.value)
        assert caught.value.exit_status == 4
        assert history[-1] == "light.close"


def test_the_identity_has_drivers_serials_and_settings_and_says_what_is_simulated(tmp_path):
    rig = open_rig(bench(tmp_path))
    found = identity(rig.facts())
    rig.close()
    assert found["kind"] == "devices" and found["simulated"] is False
    assert (found["slm.serial"], found["camera.serial"], found["camera.gain"]) == ("P-1", "C-1", 3)
    assert (found["slm.driver"], found["camera.driver"], found["light.driver"]) == ("lab", "lab", "lab")
    pretending = open_rig(bench(tmp_path, "simulated=true"))
    assert identity(pretending.facts()) == found | {"simulated": True}
    pretending.close()


def test_a_camera_that_stands_on_its_side_is_another_one_to_a_calibration_and_gives_upright_frames(tmp_path):
    straight, turned = (open_rig(bench(tmp_path, f"camera.rotate_deg={turn}")) for turn in (0, 90))
    facts = turned.facts().camera
    assert (facts.width, facts.height, facts.field_rad) == (10, 20, (0.2, 0.4))
    assert turned.camera.grab().counts.shape == (20, 10)
    assert "camera.rotate_deg" not in identity(straight.facts())
    assert identity(turned.facts())["camera.rotate_deg"] == 90
    for rig in (straight, turned):
        rig.close()


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("camera.rotate_deg=45", "camera.rotate_deg"),
        ("camera.driver=labb", "camera driver 'labb' is not known. Did you mean lab?"),
        ("camera.driver=lab-unfinished", "lab-drivers cannot be loaded"),
        ("slm.driver=3", "--set slm.driver"),
        ("optics.pupil_mm=-3", "optics.pupil_mm = -3 is not greater than 0"),
        ("optics.pupil=3", "unknown key optics.pupil. Did you mean pupil_mm?"),
        ("safety.max_exposure_s=0", "safety.max_exposure_s"),
        ("saftey.max_exposure_s=1", "unknown key saftey. Did you mean safety?"),
        ("simulated=yes", "simulated"),
    ],
)
def test_an_impossible_value_is_refused_naming_its_key(tmp_path, history, override, said):
    with pytest.raises(ConfigError) as caught:
        open_rig(bench(tmp_path, override))
    assert said in str(caught.value)
    assert "slm.open" not in history or history[-1] == "light.close"


def test_a_missing_table_and_a_missing_driver_are_refused(tmp_path):
    for cut, said in (('[light]\ndriver = "lab"\n', "light is missing"), ('driver = "lab"\n[camera]', "slm.driver")):
        text = FILE.replace(cut, cut[cut.index("[camera]") :] if "[camera]" in cut else "")
        with pytest.raises(ConfigError, match=said):
            open_rig(bench(tmp_path, text=text))


def test_a_driver_whose_extra_is_not_installed_says_what_to_install(tmp_path, monkeypatch):
    for package in ("viva_genicam", "serial"):
        monkeypatch.setitem(__import__("sys").modules, package, None)
    line = '{wavelength_nm = 473, url = "a"}, {wavelength_nm = 515, url = "b"}'
    for text, extra in (
        (
            FILE.replace(
                '[camera]\ndriver = "lab"', '[camera]\ndriver = "genicam"\nwidth = 8\nheight = 8\nfield_deg = 9.0'
            ),
            "genicam",
        ),
        (FILE.replace('[light]\ndriver = "lab"', f'[light]\ndriver = "scpi"\nlines = [{line}]'), "scpi"),
    ):
        with pytest.raises(ConfigError) as caught:
            open_rig(bench(tmp_path, text=text))
        assert f'pip install "holocal[{extra}]"' in str(caught.value)
