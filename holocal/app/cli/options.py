"""Options that several commands share, each described once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Rig = Annotated[str, typer.Option("--rig", metavar="NAME|FILE.toml", help="Rig: a built-in name or a file.")]
Runs = Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where run directories are made.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="All randomness comes from it.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY.PATH=VALUE", help="One value of the rig or of the procedure; may be repeated."),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else there.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the plan and touch nothing.")]
Device = Annotated[str, typer.Option("--device", metavar="cpu|cuda", help="Where holograms are computed.")]
Yes = Annotated[bool, typer.Option("--yes", help="Answer yes to every question.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Corrections = Annotated[
    str, typer.Option("--corrections", metavar="accepted|none|RUN", help="Which corrections are applied.")
]
Wavelength = Annotated[float, typer.Option("--wavelength-nm", help="Wavelength, nanometres.")]
Workers = Annotated[
    int, typer.Option("--workers", min=1, max=256, help="Processes on this machine; the numbers are the same.")
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="tcp://HOST:PORT", help="A Dask scheduler whose workers do it.")
]
RunDirectory = Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, or the end of its name.")]

DEFAULT_RIG = "simulated"
DEFAULT_RUNS = Path("runs")
DEVICES = ("cpu", "cuda")


def checked_device(device: str) -> str:
    """Return the device; usage error when it is not one of `DEVICES`, `ConfigError` when this machine has none."""
    if device not in DEVICES:
        raise typer.BadParameter(f"{device!r} is not one of {', '.join(DEVICES)}.", param_hint="--device")
    if device == "cuda":
        import torch

        from holocal.errors import ConfigError

        if not torch.cuda.is_available():
            raise ConfigError("this machine has no CUDA device.", fix="Use --device cpu.", code="no-cuda")
    return device


def found_run(run: Path, runs: Path = DEFAULT_RUNS) -> Path:
    """Return a run directory named by its path, its name, or the end of its name (the four letters)."""
    from holocal.errors import InputError

    if run.is_dir():
        return run
    matches = _matching(run.name, runs) if run.name == str(run) else []
    if len(matches) == 1:
        return matches[0]
    raise InputError(
        f"run {run}: {len(matches)} run directories of that name." if matches else f"run {run} does not exist.",
        fix=f"Give its path, or --runs DIR. Looked in {runs.resolve()} and where runs were made before.",
        measured=len(matches),
        limit=1,
    )


def _matching(ending: str, runs: Path) -> list[Path]:
    """Return the runs whose name ends so: those in `runs`, else those made elsewhere."""
    try:
        here = sorted(path for path in runs.glob("*") if path.name.endswith(ending) and path.is_dir())
    except OSError:
        here = []
    if here:
        return here
    from holocal.records import index

    with index.opened() as known:
        return [path for path in known.named(ending) if path.is_dir()]
