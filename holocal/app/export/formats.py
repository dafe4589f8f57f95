"""A run's contents in one file, written whole or not at all: NumPy's ``.npz``, HDF5, OpenEXR.

======  =======================================================================================
npz     an array per quantity, ``index.json`` with units and axes, ``documents/<file>`` as texts
hdf5    groups by the parts of a name; units as attributes, axes as dimension scales
exr     a part per image, with the numbers and documents in the first part's metadata
======  =======================================================================================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from holocal.app.export.contents import Contents, Quantity, contents_of, index_of
from holocal.errors import ConfigError, InputError
from holocal.records.files import atomic_path
from holocal.records.maps import write_parts


def export(run: Path, form: str, out: Path) -> Contents:
    """Write a run to `out` in one of `FORMATS` and return what was written; the run itself is not touched."""
    if run.resolve() in (out.resolve(), *out.resolve().parents):
        raise InputError(
            f"{out} lies in the run's own directory.",
            why="The run would no longer be what its manifest says.",
            fix="Write it elsewhere: --out FILE.",
        )
    contents = contents_of(run)
    FORMATS[form][1](contents, out)
    return contents


def write_npz(contents: Contents, out: Path) -> None:
    """Write the contents as NumPy arrays; none of them needs pickle to be read."""
    arrays: dict[str, Any] = {name: one.values for name, one in contents.quantities.items()}
    arrays |= {f"documents/{name}": np.array(text) for name, text in contents.documents.items()}
    arrays["index.json"] = np.array(index_of(contents))
    with atomic_path(out) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def write_hdf5(contents: Contents, out: Path) -> None:
    """Write the contents as HDF5: a dataset per quantity, its axes attached as dimension scales."""
    h5py = _h5py()
    with atomic_path(out) as temporary, h5py.File(temporary, "w") as file:
        for key, value in contents.about.items():
            file.attrs[key] = _attribute(value)
        for name, one in contents.quantities.items():
            _dataset(h5py, file, name, one)
        for name, one in contents.quantities.items():
            for dimension, axis in zip(file[name].dims, one.axes, strict=False):
                dimension.label = axis.rpartition("/")[2]
                if axis != name and axis in file:
                    dimension.attach_scale(file[axis])
        for name, text in contents.documents.items():
            file[f"documents/{name}"] = text


def write_exr(contents: Contents, out: Path) -> None:
    """Write the images as the parts of an OpenEXR file; what is no image goes into the first part's metadata."""
    if not contents.images:
        raise InputError(f"{contents.about['run']} has no images.", fix="Use --format npz or hdf5.")
    parts = dict(contents.images)
    first = next(iter(parts))
    more = {"about": dict(contents.about), "documents": dict(contents.documents)}
    parts[first] = replace(parts[first], metadata={**parts[first].metadata, **more})
    write_parts(out, parts)


FORMATS: dict[str, tuple[str, Callable[[Contents, Path], None]]] = {
    "npz": (".npz", write_npz),
    "hdf5": (".h5", write_hdf5),
    "exr": (".exr", write_exr),
}


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise ConfigError(
            "HDF5 needs the package h5py, which is not installed.",
            fix='pip install "holocal[hdf5]", or --format npz.',
            code="missing-package",
        ) from error
    return h5py


def _dataset(h5py: Any, file: Any, name: str, one: Quantity) -> None:
    values: Any = one.values
    if values.dtype.kind == "U":
        made = file.create_dataset(name, data=values.astype(object), dtype=h5py.string_dtype())
    else:
        packed = {"compression": "gzip", "shuffle": True} if values.size > 1024 else {}
        made = file.create_dataset(name, data=values, **packed)
    made.attrs["unit"] = one.unit
    if name in one.axes:
        made.make_scale(name.rpartition("/")[2])


def _attribute(value: Any) -> Any:
    from holocal.records.files import dump_json

    return value if isinstance(value, (bool, int, float, str)) else dump_json(value, indent=None)
