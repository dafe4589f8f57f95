"""Image files at the border: EXR maps by name, frames, scenes; what is refused says its number and its limit."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from holocal.errors import InputError, StorageError
from holocal.records.frames import read_counts, read_frame, write_counts, write_frame
from holocal.records.maps import read_maps, write_maps
from holocal.records.scene import read_scene

LEVELS = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20


def png(width: int, height: int, depth: int, colour: int, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG written by hand, so that what an encoder would refuse can be tried."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*one) for one in ((b"IHDR", head), *chunks, (b"IEND", b"")))


def test_exr_channels_come_back_by_name_bit_for_bit_with_their_metadata(tmp_path):
    random = np.random.default_rng(0)
    maps = {name: random.normal(size=(5, 7)).astype(np.float32) for name in ("z.last", "a.first", "m.middle")}
    maps["z.last"][0, 0] = np.nan
    write_maps(tmp_path / "m.exr", maps, units={"a.first": "rad"}, metadata={"extent_deg": (-1.0, 1.0, -2.0, 2.0)})
    found = read_maps(tmp_path / "m.exr")
    assert set(found.channels) == set(maps)
    for name, values in maps.items():
        np.testing.assert_array_equal(found.channels[name], values)
    assert found.extent_deg == (-1.0, 1.0, -2.0, 2.0)
    assert found.metadata["units"] == {"a.first": "rad"}


def test_equal_maps_give_equal_bytes(tmp_path):
    for name in ("a.exr", "b.exr"):
        write_maps(tmp_path / name, {"value": np.ones((40, 30))})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.95])
def test_an_exr_file_that_is_cut_short_is_refused(tmp_path, kept):
    path = tmp_path / "m.exr"
    write_maps(path, {"value": np.random.default_rng(1).normal(size=(64, 64))})
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(InputError, match=r"m\.exr"):
        read_maps(path)


def test_a_frame_has_its_level_in_red_and_nothing_in_green_and_blue(tmp_path):
    write_frame(tmp_path / "f.png", LEVELS)
    blue, green, red = cv2.split(cv2.imread(str(tmp_path / "f.png"), cv2.IMREAD_UNCHANGED))
    assert np.array_equal(red, LEVELS) and not green.any() and not blue.any()
    assert np.array_equal(read_frame(tmp_path / "f.png", width=4, height=3), LEVELS)


def test_a_mono8_frame_comes_back(tmp_path):
    write_frame(tmp_path / "f.png", LEVELS, "mono8")
    assert np.array_equal(read_frame(tmp_path / "f.png", width=4, height=3), LEVELS)


def test_counts_keep_all_sixteen_bits(tmp_path):
    counts = (LEVELS.astype(np.uint16) << 8) + 3
    write_counts(tmp_path / "c.png", counts)
    assert np.array_equal(read_counts(tmp_path / "c.png"), counts)


def test_a_frame_with_something_in_green_is_refused(tmp_path):
    picture = np.zeros((3, 4, 3), np.uint8)
    picture[1, 1, 1] = 7
    cv2.imwrite(str(tmp_path / "f.png"), picture)
    with pytest.raises(InputError, match="up to 7 in green or blue"):
        read_frame(tmp_path / "f.png", width=4, height=3)


def test_a_frame_of_sixteen_bits_is_refused(tmp_path):
    write_counts(tmp_path / "c.png", LEVELS.astype(np.uint16))
    with pytest.raises(InputError, match="16 bits per channel"):
        read_frame(tmp_path / "c.png", width=4, height=3)


def test_grey_colour_and_sixteen_bit_scenes_mean_the_same_light(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), LEVELS)
    cv2.imwrite(str(tmp_path / "colour.png"), np.dstack([LEVELS] * 3))
    cv2.imwrite(str(tmp_path / "deep.png"), LEVELS.astype(np.uint16) * 257)
    write_maps(tmp_path / "float.exr", {"Y": LEVELS / 255})
    for name in ("grey.png", "colour.png", "deep.png", "float.exr"):
        np.testing.assert_allclose(read_scene(tmp_path / name), LEVELS / 255, atol=1e-6, err_msg=name)


def test_colour_becomes_luminance_red_first(tmp_path):
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[..., 2] = 255  # OpenCV: blue, green, red
    cv2.imwrite(str(tmp_path / "red.png"), picture)
    np.testing.assert_allclose(read_scene(tmp_path / "red.png"), 0.2126, atol=1e-6)


def test_srgb_is_undone_where_asked(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((2, 2), 188, np.uint8))
    # IEC 61966-2-1: 188/255 is half the light
    np.testing.assert_allclose(read_scene(tmp_path / "grey.png", srgb=True), 0.503, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("empty.png", b"", "0 bytes"),
        ("text.png", b"hello", "not an image"),
        ("zero.png", png(0, 2, 8, 0), "not an image"),
        ("cut.png", png(64, 64, 8, 0, (b"IDAT", zlib.compress(bytes(64 * 65))[:20])), "cut short or damaged"),
        ("huge.png", png(9000, 9000, 8, 0, (b"IDAT", zlib.compress(bytes(9000 * 9001)))), "81 million pixels"),
        ("bomb.png", png(60000, 60000, 8, 0, (b"IDAT", zlib.compress(bytes(99)))), "not an image|million pixels"),
    ],
)
def test_a_scene_that_is_no_picture_is_refused(tmp_path, name, data, said):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=said):
        read_scene(tmp_path / name)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"Y": [[1.0, np.nan]]}, "1 values that are NaN"),
        ({"Y": [[np.inf, np.nan]]}, "2 values that are NaN"),
        ({"Y": [[-0.5, 1.0]]}, "down to -0.5"),
        ({"Y": [[0.0, 0.0]]}, "black everywhere"),
        ({"X": [[1.0]], "Y": [[1.0]]}, "2 channels"),
    ],
)
def test_a_scene_with_values_that_are_no_intensities_is_refused(tmp_path, values, said):
    write_maps(tmp_path / "s.exr", {name: np.array(rows) for name, rows in values.items()})
    with pytest.raises(InputError, match=said):
        read_scene(tmp_path / "s.exr")


def test_a_transparent_scene_is_refused_and_an_opaque_one_is_not(tmp_path):
    picture = np.full((2, 2, 4), 255, np.uint8)
    cv2.imwrite(str(tmp_path / "opaque.png"), picture)
    assert read_scene(tmp_path / "opaque.png").shape == (2, 2)
    picture[0, 0, 3] = 0
    cv2.imwrite(str(tmp_path / "clear.png"), picture)
    with pytest.raises(InputError, match=r"alpha down to 0\.000"):
        read_scene(tmp_path / "clear.png")


def test_a_palette_scene_is_read_as_its_colours(tmp_path):
    palette, indices = b"\xff\xff\xff\x00\x00\x00", zlib.compress(b"\0\0\1\0\1\0")
    (tmp_path / "p.png").write_bytes(png(2, 2, 8, 3, (b"PLTE", palette), (b"IDAT", indices)))
    np.testing.assert_allclose(read_scene(tmp_path / "p.png"), [[1, 0], [0, 1]], atol=1e-3)


def test_a_map_in_a_directory_that_is_not_there_is_a_storage_error(tmp_path):
    with pytest.raises(StorageError, match="does not exist"):
        write_maps(tmp_path / "nowhere" / "m.exr", {"value": np.ones((2, 2))})
