"""``holocal rigs``: what is installed."""

from __future__ import annotations

from holocal.app.cli import options


def rigs(json: options.Json = False, debug: options.Debug = False) -> None:
    """List the rigs that are installed, plug-ins included."""
    from holocal.app.terminal import emit, emit_json
    from holocal.records import plugins
    from holocal.records.rig import built_in_rigs, load_rig

    kinds = plugins.plugins(plugins.RIGS)
    listed = []
    for name, package in built_in_rigs().items():
        config = load_rig(name)
        listed.append({"name": name, "kind": config.kind, "file": config.source, "package": package})
    if json:
        emit_json(
            {
                "schema": 1,
                "rigs": listed,
                "kinds": [
                    {"name": kind.name, "package": kind.package, "version": kind.version, "error": kind.error}
                    for kind in kinds
                ],
            }
        )
        return
    for said in listed:
        emit(f"{said['name']:<20} {said['kind']:<12} {said['file']}")
    for kind in kinds:
        emit(f"kind {kind.name:<15} {kind.package} {kind.version}  {'broken: ' + kind.error if kind.error else 'ok'}")
