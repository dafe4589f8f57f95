"""Points in a CSV file: ``theta_x_deg, theta_y_deg, distance_m, intensity``, in any order of the columns."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from holocal.errors import InputError
from holocal.records.reading import reading
from holocal.records.scene_data import ScatteredPoints
from holocal.records.validate import closest
from holocal.units import DEGREE

COLUMNS = ("theta_x_deg", "theta_y_deg", "distance_m", "intensity")
MOST_POINTS = 10_000_000
LARGEST_ANGLE_DEG = 60.0


def read_points(path: Path) -> ScatteredPoints:
    """Return the points of a CSV file.

    The first line that is neither empty nor a comment (``#``) names the four columns. Angles are degrees from the gaze,
    x towards the panel, y up; a distance may be ``inf``.

    Raises
    ------
    InputError
        The file is absent or no such table; names the line and the column of the first value that cannot be.
    """
    with reading(path), path.open(encoding="utf-8-sig") as file:
        head, names = _header(path, file)
        table = _table(path, file, head)
    theta_x, theta_y, distance, intensity = (table[:, names.index(name)] for name in COLUMNS)
    limits = (
        ("theta_x_deg", theta_x, np.abs(theta_x) < LARGEST_ANGLE_DEG, "between -60 and 60 degrees"),
        ("theta_y_deg", theta_y, np.abs(theta_y) < LARGEST_ANGLE_DEG, "between -60 and 60 degrees"),
        ("distance_m", distance, distance > 0, "above 0 m; inf is one"),
        ("intensity", intensity, (intensity >= 0) & (intensity < np.inf), "a finite number, not negative"),
    )
    for name, values, holds, limit in limits:
        _check(path, head, name, values, holds, limit)
    if not intensity.any():
        raise InputError(f"{path}: every intensity is 0.", why="There is no light to form.", measured=0.0)
    return ScatteredPoints(np.stack([theta_x, theta_y], axis=1) * DEGREE, distance, intensity)


def _header(path: Path, file: IO[str]) -> tuple[int, list[str]]:
    """Return the number of the header's line and its names, leaving the file behind it."""
    for number, text in enumerate(iter(file.readline, ""), 1):
        line = text.partition("#")[0].strip()
        if not line:
            continue
        names = [name.strip() for name in line.split(",")]
        wrong = [f"{name!r}{closest(name, COLUMNS)}" for name in names if name not in COLUMNS]
        missing = [name for name in COLUMNS if name not in names]
        if wrong or missing or len(names) != len(COLUMNS):
            said = f"unknown: {', '.join(wrong)}" if wrong else f"missing: {', '.join(missing)}" if missing else "twice"
            raise InputError(
                f"{path}, line {number}: the header's columns cannot be ({said}).",
                fix=f"The first line is: {', '.join(COLUMNS)}.",
                measured=names,
                limit=list(COLUMNS),
            )
        return number, names
    raise InputError(f"{path} is empty.", fix=f"The first line is: {', '.join(COLUMNS)}.")


def _table(path: Path, file: IO[str], head: int) -> NDArray[np.float64]:
    # numpy takes a line of spaces for a value that is missing
    lines = (line for line in file if line.lstrip()[:1] not in ("", "#"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no rows: said below
            table = np.loadtxt(lines, delimiter=",", comments="#", ndmin=2, max_rows=MOST_POINTS + 1)
    except UnicodeDecodeError:
        raise
    except ValueError as error:
        raise _fault(path, head, str(error)) from error
    if table.size == 0:
        raise InputError(
            f"{path} has no points below its header, line {head}.", fix="Add a line per point.", measured=0, limit=1
        )
    if table.shape[1] != len(COLUMNS):
        raise _fault(path, head, f"{table.shape[1]} columns")
    if len(table) > MOST_POINTS:
        raise InputError(
            f"{path} has more than {MOST_POINTS} points.",
            fix="Leave some out; a field of 25 degrees has 6 million resolvable directions for a 3 mm pupil.",
            limit=MOST_POINTS,
        )
    return np.asarray(table, np.float64)


def _check(path: Path, head: int, name: str, values: NDArray[np.float64], holds: NDArray[np.bool_], limit: str) -> None:
    if holds.all():
        return
    row = int(np.argmin(holds))  # the first that does not hold
    number = next(number for count, (number, _) in enumerate(_rows(path, head)) if count == row)
    more = int(np.count_nonzero(~holds)) - 1
    raise InputError(
        f"{path}, line {number}: {name} is {values[row]:g}; it must be {limit}."
        + (f" ({more} more such lines.)" if more else ""),
        fix="Correct that line or remove it.",
        measured=float(values[row]),
        limit=limit,
    )


def _fault(path: Path, head: int, reason: str) -> InputError:
    """Return the error of the first line that is not four numbers."""
    for number, line in _rows(path, head):
        values = [value.strip() for value in line.split(",")]
        if len(values) != len(COLUMNS):
            return InputError(
                f"{path}, line {number}: {len(values)} values; there are {len(COLUMNS)} columns.",
                fix="Separate values with commas.",
                measured=len(values),
                limit=len(COLUMNS),
            )
        for value in values:
            if not _is_number(value):
                return InputError(f"{path}, line {number}: {value!r} is not a number.", fix="Correct that line.")
    return InputError(f"{path} is not a table of numbers: {reason}.", fix="Write four numbers per line.")


def _rows(path: Path, head: int) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line with values."""
    with path.open(encoding="utf-8-sig") as file:
        for number, text in enumerate(file, 1):
            line = text.partition("#")[0].strip()
            if number > head and line:
                yield number, line


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text  # Python would read 1_000
