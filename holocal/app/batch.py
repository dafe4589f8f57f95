"""Many scenes to as many frames: ``holocal render`` of a folder or a sequence, in one process or on several.

A frame has the bytes that its scene rendered alone has. What is done is in ``frames.jsonl`` beside the frames: the same
command again goes on where it was cut off, and renders anew what has changed since.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from holocal import __version__
from holocal.app import rendering, scenes
from holocal.app.farm import Farm, gathered
from holocal.errors import InputError, UsageError
from holocal.records.files import make_directory, sha256_of
from holocal.records.journal import Journal
from holocal.records.reading import reading
from holocal.records.rig import RigConfig, digest

JOURNAL = "frames.jsonl"
LISTS = (".toml",)  # scenes that name other files: rendered every time, since those may have changed


@dataclass(frozen=True)
class Piece:
    """A scene to be rendered: what a worker is sent."""

    known: rendering.Known
    config: RigConfig
    asked: rendering.Request
    outputs: rendering.Outputs


def scenes_of(named: Sequence[Path]) -> list[Path]:
    """Return the scenes that a command line names: files as they are, a folder's by name.

    Raises
    ------
    InputError
        A folder holds no scene.
    """
    found: list[Path] = []
    for path in named:
        inside = sorted(one for one in path.iterdir() if scenes.is_scene(one)) if path.is_dir() else [path]
        if not inside:
            raise InputError(f"{path} holds no scene.", fix=f"Scenes are {scenes.KINDS}.")
        found += inside
    return found


def render_all(
    config: RigConfig,
    asked: rendering.Request,
    outputs: rendering.Outputs,
    named: Sequence[Path],
    *,
    farm: Farm,
    said: Callable[[int, int], object],
) -> dict[str, Any]:
    """Return the JSON of all scenes, after writing the frame of each to the directory `outputs.frame`."""
    began = time.monotonic()
    directory = outputs.frame
    if outputs.phase is not None or outputs.hologram is not None:
        raise UsageError("--phase-out and --complex-out are for one scene.", fix="Render that scene alone.")
    made = _names(scenes_of(named), directory)
    make_directory(directory)
    for scene, frame in made.items():
        rendering.check(replace(asked, scene=scene), replace(outputs, frame=frame))
    known = rendering.known_of(config, asked.corrections)
    pieces = {
        _key(scene, frame, known, config, asked, outputs): Piece(
            known, config, replace(asked, scene=scene), replace(outputs, frame=frame)
        )
        for scene, frame in made.items()
    }
    found = gathered(rendered, pieces, farm, Journal(directory / JOURNAL), said, still=_still_there)
    return {
        "schema": 1,
        "rig": config.name,
        "out": str(directory),
        "seed": asked.seed,
        "scenes": [{key: value for key, value in one.items() if key != "sha256"} for one in found.values()],
        "total_seconds": time.monotonic() - began,
    }


def rendered(piece: Piece) -> dict[str, Any]:
    """Return the JSON of a scene, after writing its frames; this is what runs in a worker."""
    said = rendering.render_for(piece.known, piece.config, piece.asked, piece.outputs)
    frames = _frames(said)
    return {"file": str(piece.asked.scene), **said, "sha256": {name: sha256_of(Path(name)) for name in frames}}


def _frames(said: dict[str, Any]) -> list[str]:
    lines = said.get("frames", [said])
    return [line["frame"] for line in lines if line["frame"]]


def _names(found: Iterable[Path], directory: Path) -> dict[Path, Path]:
    """Return the frame of every scene, named as the scene is; `UsageError` where two scenes have one name."""
    made: dict[Path, Path] = {}
    taken: dict[str, Path] = {}
    for scene in found:
        other = taken.setdefault(scene.stem, scene)
        if other is not scene:
            raise UsageError(
                f"{other} and {scene} would both become {scene.stem}.png.", fix="Rename one, or render it alone."
            )
        made[scene] = directory / f"{scene.stem}.png"
    return made


def _key(
    scene: Path,
    frame: Path,
    known: rendering.Known,
    config: RigConfig,
    asked: rendering.Request,
    outputs: rendering.Outputs,
) -> str:
    """Return what decides a frame's bytes, as a name: another scene, option, rig or correction is another key."""
    with reading(scene):
        own = sha256_of(scene)
    entries = {name: accepted.entry for name, accepted in known.in_force.items()}
    what = [own, repr(replace(asked, scene=Path())), repr(known.facts), config.device, entries, outputs.packing]
    fresh = [time.time_ns()] if scene.suffix.lower() in LISTS else []
    return f"{frame.name}/{digest([*what, __version__, *fresh])[:16]}"


def _still_there(value: Any) -> bool:
    """Return whether the frames that a line of the journal vouches for are what was written."""
    return all(Path(name).is_file() and sha256_of(Path(name)) == sha256 for name, sha256 in value["sha256"].items())
