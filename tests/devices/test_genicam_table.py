"""What the GenICam driver decides without a camera: full scale, field, frame numbers, keys of its table."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holocal.errors import ConfigError
from rigs.context import DriverContext
from rigs.genicam_camera import FrameNumbers, open_camera
from rigs.genicam_table import GenicamTable

CONTEXT = DriverContext("bench-a", "bench-a.toml", (515e-9,))
TABLE = {"driver": "genicam", "width": 750, "height": 500, "field_deg": 25.0}


def table(**keys: object) -> GenicamTable:
    return GenicamTable.model_validate(TABLE | keys)


@pytest.mark.parametrize(
    ("pixel_format", "shift_bits", "full_scale"),
    [
        ("Mono8", 0, 255),
        ("Mono10", 0, 1023),
        ("Mono10Packed", 0, 1023),
        ("Mono12p", 0, 4095),
        ("Mono12", 0, 4095),
        ("Mono14", 0, 16383),
        ("Mono16", 0, 65535),
        ("Mono16", 4, 4095),  # 12 bits in the upper part of 16
        ("Mono12", 4, 4095),  # the same, under the name of what is in it
    ],
)
def test_full_scale_follows_from_the_formats_name_and_the_low_bits_that_are_dropped(
    pixel_format, shift_bits, full_scale
):
    assert table(pixel_format=pixel_format, shift_bits=shift_bits).full_scale == full_scale


def test_the_field_of_the_height_has_the_same_pixels_per_tangent():
    width_rad, height_rad = table().field_rad
    assert np.rad2deg(width_rad) == pytest.approx(25.0)
    assert np.tan(height_rad / 2) / 500 == pytest.approx(np.tan(width_rad / 2) / 750)


@given(st.integers(1, 65535), st.lists(st.integers(1, 300), max_size=50))
def test_frame_numbers_rise_by_what_16_bit_block_ids_rise_over_any_wrap(first, steps):
    """Id 0 is left out by the standard, so a wrap may count one too many: it rises, and that is what is asked."""
    numbers, block = FrameNumbers(), first
    last = numbers.of(block)
    for step in steps:
        wrapped = block + step > 65535
        block = (block + step - 1) % 65535 + 1
        number = numbers.of(block)
        assert number - last == step + wrapped
        last = number


@given(st.integers(0, 2**62), st.integers(1, 1000))
def test_frame_numbers_follow_64_bit_block_ids(first, step):
    numbers = FrameNumbers()
    assert numbers.of(first) + step == numbers.of(first + step)


@given(st.integers(500, 65535), st.integers(0, 400))
def test_a_block_id_that_does_not_rise_gives_a_number_that_does_not_rise(first, back):
    numbers = FrameNumbers()
    last = numbers.of(first)
    assert numbers.of(first - back) <= last


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"pixel_format": "RGB8"}, "camera.pixel_format = 'RGB8'"),
        ({"pixel_format": "Mono12p", "shift_bits": 4}, "Mono12p has no spare low bits"),
        ({"width": 0}, "camera.width = 0 is not at least 1"),
        ({"max_exposure_s": 0.0}, "camera.max_exposure_s"),
        ({"exposure_auto": True}, "unknown key camera.exposure_auto"),
        ({"transport": "usb"}, "camera.transport"),
        ({"serial": 42}, "camera.serial"),
    ],
)
def test_an_impossible_table_is_refused_naming_file_and_key(keys, said):
    with pytest.raises(ConfigError) as caught:
        open_camera(TABLE | keys, CONTEXT)
    assert said in str(caught.value) and "bench-a.toml" in str(caught.value)


def test_a_missing_key_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"bench-a\.toml: camera\.field_deg is missing"):
        open_camera({"driver": "genicam", "width": 8, "height": 8}, CONTEXT)
