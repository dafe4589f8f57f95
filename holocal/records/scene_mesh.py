"""A mesh in an OBJ or PLY file -> triangles with an intensity at each corner.

trimesh parses. What it takes silently and should not (measured with 4.12: indices that are 0 or relative in OBJ,
indices that are missing in PLY, files cut short) is found here.
"""

from __future__ import annotations

import re
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from holocal.errors import InputError
from holocal.records.files import one_line
from holocal.records.reading import checked_bytes
from holocal.records.scene import LUMINANCE, linear
from holocal.records.scene_data import Array, Mesh

LARGEST_FILE_BYTES = 2**28
MOST_FACES = 20_000_000
# trimesh has no error of its own: on damaged files it raises any of these, found by fuzzing
_PARSING = (ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError, NotImplementedError)


def read_mesh(path: Path, *, srgb: bool = False) -> Mesh:
    """Return the triangles of an ``.obj`` or ``.ply`` file, polygons split and groups merged, in the file's units.

    Colours of vertices or faces become luminance, else every intensity is 1; materials and textures are not read.

    Parameters
    ----------
    srgb
        Undo the sRGB transfer curve of the colours.

    Raises
    ------
    InputError
        The file is absent, damaged or of another kind, has no faces, no finite vertices, or faces without a vertex.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("obj", "ply"):
        raise InputError(f"{path} is not an .obj or .ply file.", fix="Export the mesh as one of these.", measured=kind)
    data = checked_bytes(
        path,
        largest_bytes=LARGEST_FILE_BYTES,
        what="a mesh",
        fix="Simplify the mesh; a view of 750 x 750 pixels shows half a million triangles at most.",
    )
    if kind == "obj":
        data = _checked_obj(path, data)
    else:
        _check_ply(path, data)
    mesh = _parsed(path, data, kind)
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    _check(path, vertices, faces)
    return Mesh(vertices, faces, _intensity(mesh, faces, srgb=srgb))


def _parsed(path: Path, data: bytes, kind: str) -> Any:
    options = {"skip_materials": True} if kind == "obj" else {}
    try:
        mesh = trimesh.load_mesh(BytesIO(data), file_type=kind, process=False, **options)
    except _PARSING as error:
        raise InputError(
            f"{path} cannot be read as a mesh: {one_line(str(error))}.",
            why="It is damaged, or of a form that is not read (a binary PLY that mixes triangles and polygons is one).",
            fix="Export it again, as triangles.",
        ) from error
    if not len(getattr(mesh, "faces", ())):
        raise InputError(
            f"{path} has no faces.",
            fix="Give bare points as a .csv file; see `holocal render --help`.",
            measured=0,
            limit=1,
        )
    return mesh


def _checked_obj(path: Path, data: bytes) -> bytes:
    """Return an OBJ file's text as UTF-8, or raise InputError naming the first line that cannot be."""
    if b"\0" in data:
        raise InputError(f"{path} is not a text file: it has null bytes.", fix="Export the mesh again.")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # only comments and names can hold such letters
    vertices = len(re.findall(r"^[ \t]*v[ \t]", text, re.MULTILINE))
    for number, line in enumerate(text.splitlines(), 1):
        head = line.lstrip()[:2]
        if head in ("v ", "v\t"):
            _check_obj_vertex(path, number, line)
        elif head in ("f ", "f\t"):
            _check_obj_face(path, number, line, vertices)
    return text.encode()


def _check_obj_vertex(path: Path, number: int, line: str) -> None:
    values = line.partition("#")[0].split()[1:]
    try:
        finite = len(values) >= 3 and all(isfinite(float(value)) for value in values)
    except ValueError:
        finite = False
    if not finite:
        raise InputError(
            f"{path}, line {number}: {line.strip()[:60]!r} is not a vertex of three finite numbers.",
            fix="Correct that line.",
        )


def _check_obj_face(path: Path, number: int, line: str, vertices: int) -> None:
    corners = line.partition("#")[0].split()[1:]
    try:
        indices = [int(corner.partition("/")[0]) for corner in corners]
    except ValueError:
        indices = []
    if len(indices) < 3:
        raise InputError(
            f"{path}, line {number}: {line.strip()[:60]!r} is not a face of three or more vertices.",
            fix="Correct that line.",
            measured=len(indices),
            limit=3,
        )
    wrong = next((index for index in indices if not 1 <= index <= vertices), None)
    if wrong is not None:
        raise InputError(
            f"{path}, line {number}: a face names vertex {wrong}; there are vertices 1 to {vertices}.",
            fix="Export with absolute indices." if wrong < 0 else "Correct that line.",
            measured=wrong,
            limit=vertices,
        )


def _check_ply(path: Path, data: bytes) -> None:
    """Raise InputError when an ASCII file has fewer lines than its header says, or any header too many."""
    head, end, _ = data[: 2**16].partition(b"end_header")
    declared = [int(count) for count in re.findall(rb"^element[ \t]+\S+[ \t]+(\d{1,18})\s*$", head, re.MULTILINE)]
    if not end or not data.startswith(b"ply"):
        raise InputError(
            f"{path} is not a PLY file: its header does not begin with ply or does not end.",
            fix="Export the mesh again.",
        )
    if sum(declared) > MOST_FACES * 2:
        raise InputError(
            f"{path} says that it has {sum(declared)} elements.",
            fix="Simplify the mesh.",
            measured=sum(declared),
            limit=MOST_FACES * 2,
        )
    if re.search(rb"^format[ \t]+ascii", head, re.MULTILINE):
        lines = sum(1 for line in data[len(head) + len(end) :].splitlines() if line.strip())
        if lines < sum(declared):
            raise InputError(
                f"{path} is cut short: {lines} lines below the header, which says {sum(declared)}.",
                fix="Make or copy the file again.",
                measured=lines,
                limit=sum(declared),
            )


def _check(path: Path, vertices: Array, faces: np.ndarray[Any, np.dtype[np.int64]]) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"{path}: vertices {vertices.shape} and faces {faces.shape} are not (n, 3) and (m, 3).")
    if len(faces) > MOST_FACES:
        raise InputError(
            f"{path} has {len(faces)} triangles.", fix="Simplify it.", measured=len(faces), limit=MOST_FACES
        )
    wrong = faces[(faces < 0) | (faces >= len(vertices))]
    if len(wrong):
        raise InputError(
            f"{path}: {len(wrong)} corners of faces name vertices that are not there, the first {wrong[0]}; "
            f"there are vertices 0 to {len(vertices) - 1}.",
            fix="Export the mesh again.",
            measured=int(wrong[0]),
            limit=len(vertices) - 1,
        )
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} vertices are not finite, the first is vertex {bad[0]}, counted from 0.",
            fix="Remove them, and the faces that use them.",
            measured=len(bad),
            limit=0,
        )


def _intensity(mesh: Any, faces: np.ndarray[Any, np.dtype[np.int64]], *, srgb: bool) -> Array:
    kind = mesh.visual.kind
    if kind not in ("vertex", "face"):
        return np.ones(faces.shape)
    colours = np.asarray(mesh.visual.vertex_colors if kind == "vertex" else mesh.visual.face_colors)[:, :3]
    values = (colours / 255).astype(np.float32)
    luminance = (linear(values) if srgb else values) @ np.asarray(LUMINANCE)
    return luminance[faces] if kind == "vertex" else np.repeat(luminance[:, None], 3, axis=1)
