"""Files are whole or absent; TOML and JSON say what they were given."""

from __future__ import annotations

import errno
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holocal.errors import InputError, StorageError
from holocal.records.files import atomic_path, dump_json, dump_toml, read_json, write_bytes
from holocal.records.manifest import problems, write_manifest

KEYS = st.text(min_size=1, max_size=8).filter(lambda text: text.isprintable())
SCALARS = st.one_of(
    st.booleans(),
    st.integers(-(2**53), 2**53),
    st.floats(allow_nan=False),
    st.text(st.characters(codec="utf-8", exclude_categories=["Cs"])),
)
TABLES = st.recursive(
    st.dictionaries(
        KEYS,
        st.one_of(
            SCALARS, st.lists(SCALARS, max_size=3), st.lists(st.dictionaries(KEYS, SCALARS, max_size=3), max_size=3)
        ),
        max_size=4,
    ),
    lambda inner: st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=6,
)


@given(TABLES)
def test_toml_that_is_written_reads_back_as_it_was(tables):
    assert tomllib.loads(dump_toml(tables)) == tables


def test_toml_carries_the_origin_of_a_value_as_a_comment():
    text = dump_toml({"slm": {"pitch_um": 3.74}}, comments={"slm.pitch_um": "--set"}, head="resolved")
    assert text == "# resolved\n\n[slm]\npitch_um = 3.74  # --set\n"


def test_json_has_no_nan_and_takes_numpy_numbers():
    text = dump_json({"a": np.float32(0.5), "b": float("nan"), "c": np.arange(2), "d": (1, None)}, indent=None)
    assert json.loads(text) == {"a": 0.5, "b": None, "c": [0, 1], "d": [1, None]}


def test_a_write_that_fails_leaves_the_old_file_and_no_temporary(tmp_path):
    path = tmp_path / "a.json"
    write_bytes(path, b"old")
    with pytest.raises(StorageError, match="the disk is full") as caught, atomic_path(path) as temporary:
        temporary.write_bytes(b"ne")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    assert caught.value.exit_status == 2 and str(path) in caught.value.what and caught.value.fix


def test_any_error_while_writing_leaves_no_temporary(tmp_path):
    with pytest.raises(ValueError, match="no"), atomic_path(tmp_path / "a") as temporary:
        temporary.write_bytes(b"half")
        raise ValueError("no")
    assert list(tmp_path.iterdir()) == []


def test_a_place_where_nothing_can_be_written_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="does not exist"):
        write_bytes(tmp_path / "file" / "below", b"")


@pytest.mark.parametrize("text", ["", "{", "[1]", "\xff"])
def test_json_that_is_none_is_an_input_error(tmp_path, text):
    (tmp_path / "a.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"a\.json"):
        read_json(tmp_path / "a.json")


def test_a_manifest_finds_what_was_changed_removed_and_added(tmp_path):
    for name in ("kept", "changed", "removed"):
        (tmp_path / name).write_text(name)
    write_manifest(tmp_path, "complete")
    assert problems(tmp_path) == []
    (tmp_path / "changed").write_text("CHANGED")
    (tmp_path / "removed").unlink()
    (tmp_path / "added").write_text("")
    assert [sentence.split()[0] for sentence in problems(tmp_path)] == ["changed", "removed", "added"]


def test_a_disk_that_is_really_full_leaves_nothing_behind(tmp_path):
    full = Path("/dev/full")
    if not full.exists():  # Linux has a device that is always full; elsewhere the error is raised by hand above
        return
    with pytest.raises(StorageError, match="the disk is full"), atomic_path(tmp_path / "a") as temporary:
        temporary.symlink_to(full)
        temporary.write_bytes(b"x" * 10)
    assert list(tmp_path.iterdir()) == []
