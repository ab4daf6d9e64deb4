"""`rtid`: one command per module of `rtid.cli`, imported only when it is called.

A help text or a wrong argument must not wait for numba and python-can, so only the named command
is loaded; the others stand in the list with their summary.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from importlib import import_module
from importlib.util import find_spec
from typing import Annotated, Any, NoReturn

import typer

import rtid
from firmware_bridge.kept_out import keep_out_asammdf
from rtid.cli.exits import Exit
from rtid.cli.teaching import EXAMPLES, GUIDE, next_step, panel

TAKE_BOTH = ("replay", "compare", "diagnose", "add", "drop", "report", "export")
COMMANDS = {
    "demo": "Learn the maps of a simulated machine from its CAN frames: the whole story.",
    "quick": "Judge a file without a project file: good enough, and what is missing.",
    "init": "Write a project file from a DBC or a table, with proposed roles.",
    "check": "Judge a project file against a trace: rates, gaps, ranges, signs, units.",
    "simulate": "Record a simulated machine as a trace, with its project file.",
    "replay": "Learn from a recorded trace: gates, blocks, bulk modulus, flow maps.",
    "compare": "Hold models, maps and traces against measurements: where the model fails.",
    "diagnose": "Name the physical effect that is missing in the model, or say what would tell.",
    "add": "Make a missing effect part of the model, and see the error fall.",
    "drop": "Take an effect out of the model again.",
    "undo": "Take the last change of the model back.",
    "history": "List the changes of the model, and the points in time to go back to.",
    "restore": "Go back to what the daemon had learned at a point in time.",
    "ui": "See a record and its model in the browser: where it fails, why, and add it.",
    "report": "Write the story of a trace as one HTML file with pictures.",
    "effects": "List the physical effects that may be missing in the model, or explain one.",
    "excite": "Design the motion that identifies the machine, and predict what it will tell.",
    "refit": "Fit a plant by its equations to a record, and find what they miss.",
    "run": "Learn on board from a live bus: the daemon.",
    "status": "Tell how the daemon on this machine is.",
    "accept": "Take a changed machine for the new normal, on the running daemon.",
    "apply": "Send the learned maps to the controller, all or nothing; and back.",
    "export": "Write the learned maps for controllers, calibration tools and spreadsheets.",
    "mcu": "Write the estimator in C for a controller with no computer beside it.",
    "trust": "Let the Python that a project brings along run on this machine.",
    "fleet": "Learn and diagnose thousands of traces, and rank the machines.",
}

STDIN = "-"
LASTING = ("run", "ui")  # commands that stay: they are swept as Python has it
# glibc's options: bytes from which on memory is asked for apart, and that are kept when freed
MEMORY = ((-3, "MALLOC_MMAP_THRESHOLD_", 4 << 20), (-1, "MALLOC_TRIM_THRESHOLD_", 32 << 20))
SWEPT_AFTER = 50_000, 20, 20  # new objects, then sweeps of the younger ones
OUR_PACKAGES = ("rtid", "firmware_bridge")  # their own error classes are meant for the user
EPILOG = (
    "Exit codes: 0 ok, 1 internal error, 2 usage or project file, 3 input, 4 negative result.  "
    + GUIDE
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"rtid {rtid.__version__}")
        raise typer.Exit()


def _top(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Version.")
    ] = False,
) -> None:
    """Learn the flow maps of hydraulic valves and the bulk modulus from CAN frames."""


def _unloaded() -> None:
    """Stand in for a command that was not asked for."""


def _function(name: str) -> Callable[..., Any]:
    """The function of a command, which says at its end what to do next."""
    function: Callable[..., Any] = getattr(import_module(f"rtid.cli.{name}"), name)

    @wraps(function)
    def told(**given: Any) -> None:
        outcome = function(**given)
        if step := next_step(name, given, outcome):
            print(step)

    return told


def build(arguments: Sequence[str]) -> typer.Typer:
    """Typer application in which only the command that `arguments` name is loaded."""
    app = typer.Typer(
        add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, epilog=EPILOG
    )
    app.callback()(_top)
    called = next((a for a in arguments if not a.startswith("-")), "")
    for name, summary in COMMANDS.items():
        if find_spec(f"rtid.cli.{name}"):
            function = _function(name) if name == called else _unloaded
            app.command(
                name,
                short_help=summary,
                rich_help_panel=panel(name),
                epilog=f"Example: {EXAMPLES[name]}",
            )(function)
    return app


def _refuse(message: str, remedy: str, code: int) -> NoReturn:
    print(f"rtid: {message}", file=sys.stderr)
    if remedy:
        print(f"  -> {remedy}", file=sys.stderr)
    sys.exit(code)


def in_order(words: Sequence[str]) -> list[str]:
    """The words of a command as `TRACE -p PROJECT`, where a project stands in a trace's place."""
    kept = list(words)
    if not kept or kept[0] not in TAKE_BOTH:
        return kept
    tomls = [k for k in range(1, len(kept)) if _is_project(kept[k]) and kept[k - 1][:1] != "-"]
    named = [k + 1 for k, word in enumerate(kept[:-1]) if word in ("-p", "--project")]
    if len(tomls) != 1 or any(_is_project(kept[k]) for k in named):
        return kept
    if named:
        kept[tomls[0]], kept[named[0]] = kept[named[0]], kept[tomls[0]]
        return kept
    return [*kept[: tomls[0]], *kept[tomls[0] + 1 :], "-p", kept[tomls[0]]]


def _is_project(word: str) -> bool:
    return word.lower().endswith(".toml")


def run(arguments: Sequence[str]) -> NoReturn:
    """Run one command line of `rtid` and exit; an argument `-` is the standard input."""
    with _with_stdin(in_order(arguments)) as words:
        carry_out(build(words), words, "rtid")


@contextmanager
def _with_stdin(arguments: Sequence[str]) -> Iterator[Sequence[str]]:
    """The arguments, `-` replaced by a file that holds what the standard input does."""
    if STDIN not in arguments:
        yield arguments
        return
    from firmware_bridge.sources.formats import spooled

    with spooled(sys.stdin.buffer) as path:
        yield [str(path) if word == STDIN else word for word in arguments]


def carry_out(app: typer.Typer, arguments: Sequence[str], name: str) -> NoReturn:
    """Run a command line and exit; an expected error is one plain message, no traceback."""
    try:
        typer.main.get_command(app).main(args=list(arguments), prog_name=name)
    except KeyboardInterrupt:
        sys.exit(Exit.INTERRUPTED)
    except OSError as error:
        if error.filename is None:
            raise
        _refuse(f"{error.filename}: {error.strerror}", "", Exit.INPUT)
    except Exception as error:
        if type(error).__module__.split(".")[0] not in OUR_PACKAGES:
            raise
        code = getattr(error, "exit_code", Exit.INPUT)
        _refuse(str(error), getattr(error, "remedy", ""), code)
    sys.exit(Exit.OK)


def return_large_memory() -> None:
    """Have the C library give freed matrices back to the system, here and in processes begun here.

    glibc learns from each that is freed to keep the next one, between small things that stay: 20 MB
    of a replay of a minute, 60 of one of ten minutes.  Another library has no `mallopt`.
    """
    ours = [option for option in MEMORY if option[1] not in os.environ]  # the user's own stay
    os.environ.update({name: str(size) for _, name, size in ours})  # read at a process's start
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    for option, _, size in ours:
        mallopt(option, size)


def main() -> NoReturn:
    """Entry point of the `rtid` script.

    Linear algebra stays on one thread, unless the environment says otherwise: matrices are small,
    and OpenBLAS' threads spin while they wait (`refit --diagnose` of the tanks beside another
    program: 142 s instead of 39, with the same result).
    Python looks for circles of dead objects after each 700 new ones, and a start makes 250,000 that
    stay: 8 % of a replay's time.  A command that ends looks less often.
    """
    return_large_memory()
    if not set(LASTING) & set(sys.argv[1:2]):
        gc.set_threshold(*SWEPT_AFTER)
    keep_out_asammdf()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read at the first import of numpy
    run(sys.argv[1:])
