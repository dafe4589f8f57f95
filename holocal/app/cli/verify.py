"""``holocal verify RUN``: a run's files against its manifest."""

from __future__ import annotations

from holocal.app.cli import options


def verify(
    run: options.RunDirectory,
    runs: options.Runs = options.DEFAULT_RUNS,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Check the SHA-256 and the size of every file of a run."""
    from holocal.app.terminal import emit, emit_json
    from holocal.errors import InputError
    from holocal.records.manifest import problems, read_manifest

    directory = options.found_run(run, runs)
    files = read_manifest(directory)["files"]
    if found := problems(directory):
        raise InputError(
            f"{directory.name}: {' '.join(found)}",
            why="The run is not what was measured.",
            fix="Restore the files from a copy, or measure again.",
            measured=len(found),
            limit=0,
            code="damaged-run",
        )
    if json:
        emit_json({"schema": 1, "run": str(directory), "files": len(files), "verified": True})
    else:
        emit(f"{directory.name}: {len(files)} files are what was written.")
