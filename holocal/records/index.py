"""An index of all runs, for questions about their history: made from the directories, and never the truth.

``<home>/index.sqlite`` has a row per run directory and per accepted run. It is brought into step with the directories
whenever it is opened, made anew when it is missing or damaged, and kept in memory where it cannot be written. The runs
lie where they were made: ``<home>/places/`` has a file per directory that runs were made in.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from holocal.errors import StorageError
from holocal.records.calibration import home
from holocal.records.files import json_ready, make_directory, read_json, write_json
from holocal.records.rig import digest
from holocal.records.run_files import RunSummary, is_run, part_summaries, stamp_of, summary_of

SCHEMA = 1
NAME = "index.sqlite"
BUSY_S = 5.0
COLUMNS = ("name", "path", "rig", "procedure", "utc", "status", "result")
TABLE = f"""
CREATE TABLE IF NOT EXISTS run ({", ".join(f"{name} TEXT NOT NULL" for name in COLUMNS)},
                                stamp TEXT NOT NULL, PRIMARY KEY (path));
CREATE INDEX IF NOT EXISTS run_of_rig ON run (rig, utc);
PRAGMA user_version = {SCHEMA};
"""


class Index:
    """The runs that are known; use `opened`."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def runs(self, rig: str, procedure: str | None = None) -> list[RunSummary]:
        """Return the runs of a rig, oldest first; a run whose directory is gone by what was accepted of it."""
        asked = "SELECT * FROM run WHERE rig = ? AND (? IS NULL OR procedure = ?) ORDER BY utc, name"
        found: dict[str, RunSummary] = {}
        for row in self._connection.execute(asked, (rig, procedure, procedure)):
            summary = _summary(row)
            if summary.name not in found or found[summary.name].status == "accepted":
                found[summary.name] = summary
        return list(found.values())

    def rigs(self) -> list[str]:
        """Return the names of the rigs that runs are known of."""
        asked = "SELECT DISTINCT rig FROM run WHERE rig != '' ORDER BY rig"
        return [str(row["rig"]) for row in self._connection.execute(asked)]

    def named(self, ending: str) -> list[Path]:
        """Return the run directories whose name ends so."""
        rows = self._connection.execute("SELECT path, name FROM run WHERE status != 'accepted' ORDER BY path")
        return [Path(row["path"]) for row in rows if str(row["name"]).endswith(ending)]


@contextmanager
def opened(*further: Path) -> Iterator[Index]:
    """Yield the index, in step with every directory that runs were made in and with `further` ones."""
    roots = sorted({*known_places(), *(path.resolve() for path in further)})
    with closing(_in_step(home() / NAME, roots)) as connection:
        yield Index(connection)


def remember(runs: Path) -> None:
    """Have a directory that runs are made in be known from now on."""
    path = str(runs.resolve())
    place = home() / "places" / f"{digest(path)[:16]}.json"
    if not place.is_file():
        make_directory(place.parent)
        write_json(place, {"schema": SCHEMA, "path": path})


def known_places() -> list[Path]:
    """Return the directories that runs were made in."""
    found = []
    for place in sorted((home() / "places").glob("*.json")):
        with suppress(Exception):  # a damaged file forgets one directory, and `--runs` names it again
            found.append(Path(str(read_json(place)["path"])))
    return found


def _in_step(path: Path, roots: Iterable[Path]) -> sqlite3.Connection:
    """Return a connection to the index in step with the directories, made anew, or in memory, where it must be."""
    for attempt in range(2):
        try:
            make_directory(path.parent)
            return _filled(sqlite3.connect(path, timeout=BUSY_S), roots)
        except sqlite3.OperationalError:  # it cannot be written, or another process holds it
            break
        except (sqlite3.DatabaseError, ValueError):
            if attempt == 0:
                _remove(path)
        except StorageError:
            break
    return _filled(sqlite3.connect(":memory:"), roots)


def _remove(path: Path) -> None:
    for ending in ("", "-wal", "-shm", "-journal"):
        with suppress(OSError):
            path.with_name(path.name + ending).unlink()


def _filled(connection: sqlite3.Connection, roots: Iterable[Path]) -> sqlite3.Connection:
    """Return a connection whose rows are those of the directories; `sqlite3.DatabaseError` for a damaged file."""
    try:
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA journal_mode = WAL")  # a reader and a writer at once
        if connection.execute("PRAGMA quick_check").fetchone()[0] != "ok":
            raise sqlite3.DatabaseError("damaged")
        if connection.execute("PRAGMA user_version").fetchone()[0] != SCHEMA:
            connection.executescript("DROP TABLE IF EXISTS run;" + TABLE)
        _update(connection, roots)
    except BaseException:
        connection.close()
        raise
    return connection


def _update(connection: sqlite3.Connection, roots: Iterable[Path]) -> None:
    """Bring the rows into step: only runs whose files changed are read."""
    there = {str(run): (run, accepted, stamp_of(run)) for run, accepted in _runs_in(roots)}
    known = {str(row["path"]): str(row["stamp"]) for row in connection.execute("SELECT path, stamp FROM run")}
    rows, changed = [], []
    for path, (run, accepted, stamp) in there.items():
        if known.get(path) == stamp:
            continue
        changed.append((path, f"{path}/%"))
        summary = summary_of(run, accepted=accepted)
        rows += [_row(one, stamp) for one in (summary, *part_summaries(run, summary))]
    gone = [(path, f"{path}/%") for path in known if path not in there and str(Path(path).parent) not in there]
    if rows or gone:
        marks = ", ".join("?" * (len(COLUMNS) + 1))
        with connection:
            connection.executemany("DELETE FROM run WHERE path = ? OR path LIKE ?", gone + changed)
            connection.executemany(f"INSERT OR REPLACE INTO run VALUES ({marks})", rows)


def _row(summary: RunSummary, stamp: str) -> tuple[str, ...]:
    said = asdict(summary)
    said["result"] = json.dumps(json_ready(said["result"]))
    return (*(said[name] for name in COLUMNS), stamp)


def _runs_in(roots: Iterable[Path]) -> Iterator[tuple[Path, bool]]:
    """Yield the run directories of `roots`, and those that were accepted; links are not followed."""
    for root in roots:
        yield from ((run, False) for run in _directories(root) if is_run(run))
    for rig in _directories(home() / "rigs"):
        yield from ((run, True) for run in _directories(rig / "entries") if is_run(run))


def _directories(path: Path) -> list[Path]:
    try:
        with os.scandir(path) as entries:
            found = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
    except OSError:
        return []
    return [path / name for name in sorted(found) if not name.startswith(".") and name.isprintable()]


def _summary(row: Any) -> RunSummary:
    values = {name: row[name] for name in COLUMNS}
    try:
        return RunSummary(**{**values, "result": dict(json.loads(values["result"]))})
    except (TypeError, ValueError):  # a row that was tampered with: the directory says it again
        return summary_of(Path(str(values["path"])), accepted=values["status"] == "accepted")
