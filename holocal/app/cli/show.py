"""``holocal show RUN``: what a run found, on the terminal."""

from __future__ import annotations

from typing import Any

from holocal.app.cli import options


def show(
    run: options.RunDirectory,
    runs: options.Runs = options.DEFAULT_RUNS,
    json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Show what a run found: verdict, numbers before and after, steps."""
    from holocal.app.report.numbers import goals, number
    from holocal.app.terminal import emit, emit_json
    from holocal.errors import InputError
    from holocal.loop.record import read_journal
    from holocal.records.files import read_json

    directory = options.found_run(run, runs)
    if not (directory / "config.toml").is_file():
        raise InputError(f"{directory} is not a run directory: it has no config.toml.", fix="Give the path of a run.")
    manifest, result = directory / "manifest.json", directory / "result.json"
    status = read_json(manifest)["status"] if manifest.is_file() else "unfinished"
    steps = [line for line in read_journal(directory) if line["event"] == "step"]
    found: dict[str, Any] = read_json(result) if result.is_file() else {}
    if json:
        emit_json({**found, "status": status} if found else {"schema": 1, "run": str(directory), "status": status})
        return
    emit(f"{directory.name}  {status}")
    if found:
        emit(str(found["sentence"]))
        for row in goals(found):
            wanted = "" if row["target"] is None else f"   target {number(row['target'])}"
            emit(f"  {row['name']:<35} {number(row['before']):>10} -> {number(row['after']):>10}{wanted}")
    elif (directory / "error.json").is_file():
        emit(str(read_json(directory / "error.json")["what"]))
    for step in steps:
        said = step["progress"]
        emit(f"  step {step['step']}: {said.get('quantity', 'value')} {number(said.get('value'))}  {step['sentence']}")
