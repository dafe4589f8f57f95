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
    from holocal.records.manifest import require_intact

    directory = options.found_run(run, runs)
    files = require_intact(directory)["files"]
    if json:
        emit_json({"schema": 1, "run": str(directory), "files": len(files), "verified": True})
    else:
        emit(f"{directory.name}: {len(files)} files are what was written.")
