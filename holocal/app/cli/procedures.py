"""``holocal procedures``: what is installed."""

from __future__ import annotations

from holocal.app.cli import options


def procedures(json: options.Json = False, debug: options.Debug = False) -> None:
    """List the procedures that are installed, plug-ins included."""
    from holocal.app.terminal import emit, emit_json
    from holocal.records import plugins

    found = plugins.plugins(plugins.PROCEDURES)
    listed = [
        {
            "name": plugin.name,
            "package": plugin.package,
            "version": plugin.version,
            "error": plugin.error,
            "summary": "" if plugin.target is None else (plugin.target.__doc__ or "").strip().split("\n")[0],
        }
        for plugin in found
    ]
    if json:
        emit_json({"schema": 1, "procedures": listed})
        return
    for said in listed:
        state = f"broken: {said['error']}" if said["error"] else said["summary"]
        emit(f"{said['name']:<16} {said['package']} {said['version']}  {state}")
