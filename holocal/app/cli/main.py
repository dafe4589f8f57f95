"""The application, and the one place where errors end: each with its message and its exit status.

Status: 0 done, 1 a bug, 2 usage or configuration, 3 target not met, 4 refused, 5 safety stop, 6 device lost,
75 rig in use, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Annotated, Any

import typer

from holocal import __version__
from holocal.app.cli import (
    accept,
    bench,
    capture,
    check,
    compare,
    detect_grid,
    doctor,
    export,
    history,
    procedures,
    render,
    report,
    resume,
    rigs,
    run,
    show,
    tolerance,
    verify,
)
from holocal.app.memory import return_freed_memory
from holocal.errors import HolocalError, Interrupted

# Small float64 products in several threads: with its own threads under ours, OpenBLAS made the simulated bench's set-up
# 18 times slower (6.7 s instead of 0.36 s on two cores). Must be set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# click's ClickException, from wherever this version of typer keeps click: BadParameter is a UsageError is one of them.
ClickException: Any = typer.BadParameter.__mro__[2]

app = typer.Typer(
    name="holocal",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Closed-loop calibration and correction of holographic near-eye displays.",
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"holocal {__version__}")
        raise typer.Exit


@app.callback()
def holocal(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Closed-loop calibration and correction of holographic near-eye displays."""


COMMANDS: tuple[Callable[..., None], ...] = (
    run.run,
    resume.resume,
    accept.accept,
    check.check,
    report.report,
    show.show,
    verify.verify,
    export.export,
    history.history,
    compare.compare,
    render.render,
    capture.capture,
    detect_grid.detect_grid,
    bench.bench,
    tolerance.tolerance,
    rigs.rigs,
    procedures.procedures,
    doctor.doctor,
)


def _saying_so(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that ends with our error when it is interrupted: typer would end it without a word."""

    @wraps(command)
    def interruptible(*arguments: Any, **options: Any) -> None:
        try:
            command(*arguments, **options)
        except KeyboardInterrupt as error:  # SIGINT; of a command that has a rig open SIGTERM and SIGHUP too
            raise Interrupted("stopped by the operator.") from error

    return interruptible


for command in COMMANDS:
    app.command()(_saying_so(command))


def invoke(arguments: Sequence[str]) -> int:
    """Return the exit status of a command line; messages are on stderr, results on stdout."""
    as_json, debug = "--json" in arguments, "--debug" in arguments
    try:
        status = typer.main.get_command(app).main(list(arguments), prog_name="holocal", standalone_mode=False)
        return status if isinstance(status, int) else 0
    except ClickException as error:
        error.show()
        if as_json:
            _json_error({"code": "usage", "what": error.format_message(), "exit_status": 2})
        return int(error.exit_code)
    except HolocalError as error:
        return _ended(error, as_json=as_json, debug=debug)
    except (KeyboardInterrupt, typer.Abort):
        return _ended(Interrupted("stopped by the operator."), as_json=as_json, debug=False)
    except BrokenPipeError:  # `holocal show RUN | head`
        sys.stderr.close()
        return 0
    except Exception as error:  # the last border: a bug is one line and status 1 (contract), its traceback in the log
        if debug:
            raise
        what = f"{type(error).__name__}: {error}"
        bug = HolocalError(
            f"a bug: {' '.join(what.split())}.",
            fix="The traceback is in the run's log.txt; or run it again with --debug.",
            code="bug",
        )
        return _ended(bug, as_json=as_json, debug=False)


def main() -> None:
    """Run the command line of this process."""
    return_freed_memory()
    sys.exit(invoke(sys.argv[1:]))


def _ended(error: HolocalError, *, as_json: bool, debug: bool) -> int:
    from holocal.app.terminal import show_error

    if debug:
        import traceback

        traceback.print_exception(error)
    show_error(error)
    if as_json:
        _json_error(error.as_json())
    return error.exit_status


def _json_error(error: dict[str, object]) -> None:
    from holocal.app.terminal import emit_json

    emit_json({"schema": 1, "error": error})
