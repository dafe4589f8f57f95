"""The data of a report's figures, kept beside the run so that the report can be drawn again."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.loop.procedure import Figure
from holocal.records.files import write_bytes

NAME = "figures.npz"


def write_figures(directory: Path, figures: Sequence[Figure]) -> None:
    """Write the figures' arrays and words to ``figures.npz``."""
    words: list[dict[str, Any]] = []
    arrays: dict[str, NDArray[Any]] = {}
    for number, figure in enumerate(figures):
        words.append(
            {
                "name": figure.name,
                "title": figure.title,
                "kind": figure.kind,
                "unit": figure.unit,
                "caption": figure.caption,
                "extent_deg": figure.extent_deg,
                "target": figure.target,
                "labels": list(figure.labels),
                "arrays": list(figure.arrays),
            }
        )
        arrays |= {f"{number}/{key}": np.asarray(array) for key, array in figure.arrays.items()}
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(words).encode(), np.uint8)
    np.savez_compressed(buffer, allow_pickle=False, words=text, **arrays)
    write_bytes(directory / NAME, buffer.getvalue())


def read_figures(directory: Path) -> tuple[Figure, ...]:
    """Return the figures of a run; none when it did not get that far."""
    path = directory / NAME
    if not path.is_file():
        return ()
    try:
        with np.load(path, allow_pickle=False) as stored:
            words = json.loads(stored["words"].tobytes())
            return tuple(
                Figure(
                    name=said["name"],
                    title=said["title"],
                    kind=said["kind"],
                    arrays={key: stored[f"{number}/{key}"] for key in said["arrays"]},
                    unit=said["unit"],
                    caption=said["caption"],
                    extent_deg=tuple(said["extent_deg"]) if said["extent_deg"] else None,
                    target=said["target"],
                    labels=tuple(said.get("labels", ())),  # runs of before there were any have none
                )
                for number, said in enumerate(words)
            )
    except (ValueError, KeyError, OSError) as error:
        raise InputError(f"{path} is damaged: {error}.", fix="`holocal verify RUN` says what changed.") from error
