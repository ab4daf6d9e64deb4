"""`rtid demo`: watch a machine's maps being learned from its CAN frames, then see the result."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from shutil import which
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.units import LPM, MPA, Z95

if TYPE_CHECKING:
    from rich.console import Console

    from rtid.study.compared import TraceComparison
    from rtid.study.demo import Demo

WIDTH = 110  # where the output is no terminal


def demo(
    folder: Annotated[Path, typer.Option(help="Trace, project file and pictures go here.")] = Path(
        "rtid-demo"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Another number, another machine.")] = 1,
    duration_s: Annotated[float, typer.Option("--duration", min=20.0, help="Seconds.")] = 60.0,
    speed: Annotated[float, typer.Option(help="Times real time; 0: as fast as possible.")] = 0.0,
    pictures: Annotated[
        Path | None, typer.Option(help="Also draw coverage, maps and residual into this folder.")
    ] = None,
    open_page: Annotated[
        bool, typer.Option("--ui", help="At the end, open the page on a worn machine.")
    ] = False,
) -> None:
    """Learn the flow maps of a simulated machine from its CAN frames.

    A hydraulic cylinder on four cartridge valves moves; its controller speaks on a virtual CAN
    bus; rtid listens, learns the four maps and the bulk modulus together, and never sees a flow.
    """
    from rich.console import Console

    from rtid.study.demo import prepare, wear

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, emoji=False, width=WIDTH)
    with console.status("simulating a machine nobody has measured ..."):
        machine = prepare(folder, seed, duration_s)
    _print_live(console, machine, speed or float("inf"))
    comparison = _desk(machine)
    _print_result(console, machine, comparison)
    if pictures is not None:
        from rtid.tell.replay import LearnedStory

        for path in LearnedStory(comparison).draw(pictures, "png"):
            console.print(f"wrote {path}")
    with console.status("letting its piston seal wear out ..."):
        worn = wear(machine)
    _print_next(console, machine, worn)
    if open_page:
        _open_page(*worn)


def _print_live(console: Console, machine: Demo, speed: float) -> None:
    """One line per look at the growing estimate."""
    console.print(
        "\n[bold]1  On board[/bold]  The machine's CAN frames arrive: valve command, pressures, "
        "position.\n   No flow sensor, no data sheet; rtid starts with empty maps.",
        markup=True,
    )
    names = [chamber.name for chamber in machine.project.model.chambers]
    heads = "  ".join(f"{f'bulk modulus {name}, MPa':>21}" for name in names)
    console.print(f"\n   {'machine time':>12}  {'frames':>8}  {'blocks known':>12}  {heads}")
    for look in machine.live(speed):
        pairs = zip(look.solution.beta_pa, look.solution.beta_sd_pa, strict=True)
        betas = "  ".join(f"{f'{b * MPA:.1f} ± {Z95 * sd * MPA:.1f}':>21}" for b, sd in pairs)
        console.print(f"   {look.t_s:10.0f} s  {look.frames:8,}  {look.valid:12}  {betas}")


def _desk(machine: Demo) -> TraceComparison:
    from rtid.tell.replay import progress_bar

    with progress_bar() as progress:
        return machine.desk(progress)


def _print_result(console: Console, machine: Demo, comparison: TraceComparison) -> None:
    """What was learned, beside what the simulator kept to itself."""
    fit, plant = comparison.replay.fit, machine.plant
    solution = fit.solution
    console.print(
        "\n[bold]2  On the desk[/bold]  The same frames, replayed from the log, with refined "
        "weights and the spool lag as an unknown.",
        markup=True,
    )
    console.print(f"\n   {'':24}{'learned (95 %)':>22}{'true':>12}")
    for chamber, b, sd in zip(
        comparison.replay.model.chambers, solution.beta_pa, solution.beta_sd_pa, strict=True
    ):
        learned = f"{b * MPA:.1f} ± {Z95 * sd * MPA:.1f} MPa"
        true = f"{plant.beta_pa * MPA:.1f} MPa"
        console.print(f"   {f'bulk modulus, chamber {chamber.name}':24}{learned:>22}{true:>12}")
    lag = f"{fit.lag_s * 1e3:.3f} ± {Z95 * fit.lag_sd_s * 1e3:.3f} ms"
    console.print(f"   {'lag of the spools':24}{lag:>22}{f'{plant.lag_s * 1e3:.3f} ms':>12}")
    for error in machine.map_errors(comparison):
        learned = f"{100 * error.mean:.3f} % mean error"
        console.print(
            f"   {f'flow map of valve {error.edge}':24}{learned:>22}"
            f"   of its largest flow (worst {100 * error.largest:.2f} %)"
        )
    _print_answer(console, comparison)


def _print_answer(console: Console, comparison: TraceComparison) -> None:
    """Data sheet and learned map on the part of the trace that the fit has not seen."""
    console.print("\n   What each map leaves unexplained of the flow, on motion it has not seen:")
    for tested in reversed(comparison.held):
        part = tested.parts["validation"]
        cells = "   ".join(
            f"chamber {chamber.name} {rms * LPM:6.3f} L/min = {100 * share:5.2f} %"
            for chamber, rms, share in zip(
                comparison.replay.model.chambers,
                part.residual_rms_m3s,
                part.residual_share,
                strict=True,
            )
        )
        console.print(f"   {tested.name:12}{cells}")


def _print_next(console: Console, machine: Demo, worn: tuple[Path, Path]) -> None:
    """Commands to go on with, each on a line that can be pasted."""
    trace, project = machine.trace, machine.project.path
    console.print(
        "\n[bold]3  Your turn[/bold]  The trace and its project file are yours to try:", markup=True
    )
    _print_command(console, "check", trace, "-p", project)
    _print_command(console, "replay", trace, "-p", project, "--pictures", trace.parent)
    _print_command(console, "export", trace, trace.parent / "map.csv", "-p", project)
    console.print(
        "\n[bold]4  What is missing?[/bold]  Years later something in this machine has worn out, "
        "and the model\n   does not know.  See it in the browser: where it fails, why, and add it:",
        markup=True,
    )
    _print_command(console, "ui", worn[0], "-p", worn[1])
    console.print()


def _print_command(console: Console, *words: str | Path) -> None:
    """One line however long: what a terminal breaks by itself is still pasted as one."""
    line = shlex.join([*program(), *map(str, words)])
    console.print(f"   {line}", style="bold", soft_wrap=True)


def program() -> list[str]:
    """The words that call rtid from this shell: as it was called where `rtid` is not found."""
    if which("rtid"):
        return ["rtid"]
    called = Path(sys.argv[0])
    return [sys.executable, "-m", "rtid"] if called.name == "__main__.py" else [str(called)]


def _open_page(trace: Path, project: Path) -> None:
    from rtid.cli.ui import ui

    ui([trace], project, port=0)
