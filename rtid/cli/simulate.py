"""`rtid simulate`: record a simulated machine as a trace, or let it speak on a test bus."""

from __future__ import annotations

import json
import sys
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import typer

from firmware_bridge.playback import AS_FAST_AS_POSSIBLE, send
from rtid.cli.exits import Exit
from rtid.cli.options import AsJson
from rtid.errors import RtidError
from rtid.sim.bus import open_test_bus, run_frames
from rtid.sim.demand import MOTIONS
from rtid.sim.hidden import hide_wish, known
from rtid.sim.other_plants import write_example
from rtid.sim.random_plants import draw
from rtid.sim.recording import TABLE_SUFFIX, write_run
from rtid.sim.run import PlantChange, Run
from rtid.sim.run import simulate as run_machine
from rtid.sim.run_files import START_US, SUFFIXES
from rtid.sim.simulated_plant import SimulatedPlant

PROGRAMMABLE = "programmable_valve"


TraceFile = Annotated[
    Path | None, typer.Argument(help="File to write: .blf, .log (candump), .asc or .parquet.")
]
Number = Annotated[
    int | None, typer.Option(help="Number of a random machine; the default one without it.")
]
CrossPort = Annotated[
    bool, typer.Option("--cross-port", help="A fifth valve A<->B (random machines).")
]
Hide = Annotated[
    list[str] | None,
    typer.Option(
        help="Physics to hide: EFFECT[:WHERE][=STRENGTH], STRENGTH weak, middle, strong or a "
        "number in SI units; repeatable.  An unknown EFFECT lists all."
    ),
]
HideAt = Annotated[
    float | None,
    typer.Option("--hide-at", min=0.0, help="Seconds into the run at which that begins."),
]


Motion = Annotated[str, typer.Option(help=" | ".join(MOTIONS))]
DurationS = Annotated[
    float | None, typer.Option("--duration", min=0.01, help="Seconds; 80, a record 110.")
]
Seed = Annotated[int, typer.Option(min=0, help="Of noise and motion.")]
Example = Annotated[
    str | None,
    typer.Option(
        help="Another plant: programmable_valve, a boom on five valves, as a log; "
        "electric_drive | heated_room, as .csv for `rtid refit`."
    ),
]
Bus = Annotated[
    str | None,
    typer.Option(
        help="Send live on INTERFACE or INTERFACE:CHANNEL, as `rtid run` takes it: "
        "udp_multicast, virtual, or socketcan with vcan."
    ),
]
ChannelOption = Annotated[str, typer.Option(help="Channel of the bus, where --bus names none.")]
Speed = Annotated[float, typer.Option(help="On the bus: times real time; 0: as fast as possible.")]


def simulate(
    trace: TraceFile = None,
    plant: Number = None,
    cross_port: CrossPort = False,
    hide: Hide = None,
    hide_at_s: HideAt = None,
    motion: Motion = "sweep",
    duration_s: DurationS = None,
    seed: Seed = 0,
    example: Example = None,
    bus: Bus = None,
    channel: ChannelOption = "239.74.163.2",
    speed: Speed = 1.0,
    as_json: AsJson = False,
) -> str | None:
    """Record a simulated machine: the trace, the truth (.truth.json), a project file (.toml).

    The trace then replays with `rtid replay TRACE --project TRACE.toml`.  With --bus the machine
    speaks live instead of, or after, writing.  With --example another plant is recorded: a boom
    whose five valves have a command each, its controller driven with the data sheet (--plant for
    its number), or one for `rtid refit`, with an effect that its equations miss (not with --hide
    none).

    Motions: sweep is the paper's sine of rising frequency; dither, supply and load add steps of the
    command, a wandering supply, a varying load; rich adds all three; push loads shut valves; moves
    goes from point to point.  sweep_record and rich_record end in moves that are held out.
    """
    if example == PROGRAMMABLE:
        _programmable(trace, 0 if plant is None else plant, hide, as_json)
        return None
    if example is not None:
        _example(example, trace, seed, hide, as_json)
        return "equations"
    _check_arguments(trace, bus, motion, plant, cross_port)
    if hide_at_s is not None and not hide:
        raise _usage("--hide-at: nothing is hidden", "add --hide EFFECT")
    from rtid.tell.replay import progress_bar

    healthy = SimulatedPlant() if plant is None else draw(plant, cross_port=cross_port)
    machine = reduce(hide_wish, hide or (), healthy)
    later = None if hide_at_s is None else PlantChange(hide_at_s, machine)
    with progress_bar() as progress:
        progress("simulating the machine", 0.0)
        run = run_machine(healthy if later else machine, motion, seed, duration_s, change=later)
        progress("writing the trace", 0.7)
        written = write_run(trace, run, seed, motion) if trace else []
    interface, _, named = (bus or "").partition(":")
    channel = named or channel
    sent = _send(run, interface, channel, speed or AS_FAST_AS_POSSIBLE) if bus else 0
    if as_json:
        print(json.dumps(_plain(machine, run) | _files(written) | {"frames_sent": sent}))
    else:
        _tell(machine, run, written, f"sent {sent} frames on {interface}:{channel}" if sent else "")
    return None if written else "live"


def _plain(machine: SimulatedPlant, run: Run) -> dict[str, Any]:
    hidden = [planted._asdict() for planted in machine.hidden]
    return {"samples": len(run.samples), "beta_pa": machine.beta_pa, "hidden": hidden}


def _files(written: list[Path]) -> dict[str, Any]:
    return {"files": [str(path) for path in written]}


def _print_written(written: list[Path]) -> None:
    for path in written:
        print(f"wrote {path}")


def _tell(machine: SimulatedPlant, run: Run, written: list[Path], sent: str) -> None:
    print(f"{len(run.samples)} samples, bulk modulus {machine.beta_pa / 1e6:.0f} MPa")
    for name, where, strength in machine.hidden:
        place = f" at {where}" if where else ""
        print(f"hidden: {name}{place}, {strength:g} {known(name).unit}")
    _print_written(written)
    if sent:
        print(sent)


def _example(
    name: str, table: Path | None, seed: int, hide: list[str] | None, as_json: bool
) -> None:
    if table is None:
        raise _usage("--example: nothing to write to", "name a .csv file")
    if hide not in (None, ["none"]):
        raise _usage("--example has one effect of its own", "--hide none leaves it out")
    recorded, written = write_example(name, table, seed, hide is None)
    if as_json:
        effect = {"effect": recorded.hidden, "size": recorded.size, "unit": recorded.unit}
        print(json.dumps({"hidden": [effect] if recorded.size else []} | _files(written)))
        return
    size = f"{recorded.hidden}, {recorded.size:.3g} {recorded.unit}"
    print(f"hidden: {size if recorded.size else 'nothing'}")
    _print_written(written)


def _programmable(trace: Path | None, number: int, hide: list[str] | None, as_json: bool) -> None:
    """The boom with this number follows the paper's sweep, each valve by a command of its own."""
    if trace is None or trace.suffix not in SUFFIXES or not trace.parent.is_dir():
        raise _usage(f"{trace}: cannot be written", f"name a log: {', '.join(SUFFIXES)}")
    from rtid.sim.programmable import five_valves, record_sweep

    written = record_sweep(trace, reduce(hide_wish, hide or (), five_valves(number)), number)
    if as_json:
        print(json.dumps(_files(written)))
    else:
        _print_written(written)


def _check_arguments(
    trace: Path | None, bus: str | None, motion: str, plant: int | None, cross_port: bool
) -> None:
    """Refuse at once what would fail after the simulation."""
    known = (*SUFFIXES, TABLE_SUFFIX)
    if trace is None and bus is None:
        raise _usage("nothing to do", "name a file to write, or a bus with --bus")
    if trace is not None and trace.suffix not in known:
        raise _usage(f"{trace}: unknown kind of trace", f"use one of {', '.join(known)}")
    if trace is not None and not trace.parent.is_dir():
        raise _usage(f"{trace.parent}: no such folder", "create it first")
    if motion not in MOTIONS:
        raise _usage(f"--motion {motion}: unknown", f"use one of {', '.join(MOTIONS)}")
    if cross_port and plant is None:
        raise _usage("--cross-port: the default machine has four valves", "add --plant NUMBER")


def _usage(message: str, remedy: str) -> RtidError:
    return RtidError(message, remedy, Exit.USAGE)


def _send(run: Run, interface: str, channel: str, speed: float) -> int:
    """Speak on the bus, with a progress bar on a terminal; the number of frames sent."""
    from rich.console import Console
    from rich.progress import track

    from firmware_bridge.frames import to_messages

    frames = run_frames(run, start_us=START_US)
    console = Console(stderr=True, markup=False, emoji=False)
    messages = track(
        to_messages(frames),
        "sending",
        total=len(frames),
        console=console,
        disable=not sys.stderr.isatty(),
    )
    with open_test_bus(interface, channel) as bus:
        return send(bus, messages, speed)
