"""A frozen state to a file and back."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import dataclass
from enum import Enum

import numpy as np
import pytest

from holocal.errors import InputError
from holocal.loop.checkpoint import Progress, read_checkpoint, state_bytes, state_from_bytes, write_checkpoint


class Phase(Enum):
    COARSE = 1
    FINE = 2


@dataclass(frozen=True)
class Inner:
    scale: float
    phase: Phase


@dataclass(frozen=True)
class State:
    step: int
    picture: np.ndarray
    inner: Inner
    history: tuple[Inner, ...]
    words: dict[str, tuple[int, ...]]
    best: float
    missing: None = None
    weight: complex = 1 + 2j
    scalar: np.float32 | None = None


def state(step: int = 3) -> State:
    picture = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    picture[0, 0] = np.nan
    inner = Inner(0.1 + 0.2, Phase.FINE)
    return State(
        step,
        picture,
        inner,
        (inner, Inner(float("inf"), Phase.COARSE)),
        {"a": (1, 2)},
        float("nan"),
        scalar=np.float32(0.1),
    )


def test_a_state_comes_back_as_it_was():
    found, given = state_from_bytes(state_bytes(state())), state()
    assert isinstance(found, State)
    np.testing.assert_array_equal(found.picture, given.picture)
    assert found.picture.dtype == np.float32
    assert (found.inner, found.history, found.words) == (given.inner, given.history, given.words)
    assert np.isnan(found.best) and found.missing is None and found.weight == 1 + 2j
    assert found.scalar == np.float32(0.1) and isinstance(found.scalar, np.float32)


def test_a_state_of_objects_is_refused_while_it_is_written():
    with pytest.raises(TypeError, match="set"):
        state_bytes(Inner({1, 2}, Phase.FINE))
    with pytest.raises(TypeError, match="not of objects"):
        state_bytes(Inner(np.array([None]), Phase.FINE))


def test_two_slots_take_turns_so_the_one_in_use_is_never_overwritten(tmp_path):
    assert read_checkpoint(tmp_path) is None
    for step in range(3):
        write_checkpoint(tmp_path, state(step), Progress(step, 2 * step, 1.5, 100))
        assert json.loads((tmp_path / "checkpoint.json").read_text())["file"] == f"checkpoint-{step % 2}.npz"
        found, progress = read_checkpoint(tmp_path)
        assert found.step == step and progress == Progress(step, 2 * step, 1.5, 100)


def test_a_checkpoint_with_one_flipped_bit_is_refused(tmp_path):
    write_checkpoint(tmp_path, state(), Progress(0, 0, 0.0, 0))
    data = bytearray((tmp_path / "checkpoint-0.npz").read_bytes())
    data[len(data) // 3] ^= 1
    (tmp_path / "checkpoint-0.npz").write_bytes(bytes(data))
    with pytest.raises(InputError, match="SHA-256"):
        read_checkpoint(tmp_path)


def test_a_checkpoint_never_has_anything_imported():
    tree = {"dataclass": "sndhdr:SndHeaders", "fields": {}}
    buffer = io.BytesIO()
    np.savez(buffer, __tree__=np.frombuffer(json.dumps(tree).encode(), np.uint8))
    with pytest.raises(InputError, match="sndhdr:SndHeaders"):
        state_from_bytes(buffer.getvalue())
    assert "sndhdr" not in sys.modules
