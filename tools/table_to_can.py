"""Turn a table of a recorded machine into a CAN log, with realistic timing.

    python tools/table_to_can.py TABLE OUT.blf|OUT.log [options]

TABLE is Parquet or CSV with a time column (default `t`, seconds); integer columns of Parquet may
carry `scale` and `offset` in their field metadata.  Two modes:

cycle      every row becomes one controller cycle: all messages back to back, 130 us apart, with a
           small wait for the bus (exponential, mean --jitter-us), alive counter and CRC.
multirate  every message has a task of its own (--rate), with its own phase, its own constant age
           of the values at the time stamp (--offset, else drawn from 0.5..5 ms) and the jitter of
           a real vehicle: its 50 ms message arrives 47.1..53.0 ms apart (1..99 %), scaled to each
           period by --jitter.  The task reads sensors by linear interpolation and commands as held;
           the stamp is that instant + the age + a wait for the bus of 0..0.2 ms.

OUT.json beside the log holds what was really done (offsets, rates, seed), for scoring.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import typer

from firmware_bridge.catalog import CONTROLLER_DBC, load
from rtid.plain import FloatArray
from rtid.sim.frames import (
    ARBITRATION_US,
    CONTROLLER_ROUTES,
    TASK_JITTER,
    Route,
    Task,
    cycle_frames,
    messages_of,
    multirate_frames,
)
from rtid.sim.run_files import START_US, write_log

DEFAULT_RATES_HZ = {"ValveCommand": 100.0, "Pressures": 200.0, "Motion": 50.0}


class Mode(StrEnum):
    """How the frames are timed."""

    CYCLE = "cycle"
    MULTIRATE = "multirate"


def read_table(path: Path) -> dict[str, FloatArray]:
    """The columns of a Parquet or CSV file as float64, lower-case names, scale and offset applied.

    Raises typer.BadParameter for anything else.
    """
    if path.suffix not in (".parquet", ".csv"):
        raise typer.BadParameter(f"{path}: give a .parquet or .csv table")
    table = pa.parquet.read_table(path) if path.suffix == ".parquet" else pa.csv.read_csv(path)
    columns = {}
    for field in table.schema:
        metadata = field.metadata or {}
        scale, offset = float(metadata.get(b"scale", 1)), float(metadata.get(b"offset", 0))
        counts = table[field.name].to_numpy().astype(np.float64)
        columns[field.name.lower()] = counts * scale + offset
    return columns


def parse_routes(texts: Iterable[str]) -> dict[str, Route]:
    """Routes from `column=Message.Signal[*factor][:held]`."""
    routes = {}
    for text in texts:
        column, equals, target = text.partition("=")
        target, _, suffix = target.partition(":")
        target, _, factor = target.partition("*")
        message, dot, signal = target.partition(".")
        if not (equals and dot and suffix in ("", "held")):
            raise typer.BadParameter(f"--map {text}: write column=Message.Signal[*factor][:held]")
        scale = _number(factor, "--map", text) if factor else 1.0
        routes[column.lower()] = Route(message, signal, scale, suffix == "held")
    return routes


def parse_values(texts: Iterable[str], option: str) -> dict[str, float]:
    """Numbers per message from `Message=number`."""
    pairs = (text.partition("=") for text in texts)
    return {name: _number(number, option, f"{name}={number}") for name, _, number in pairs}


def _number(text: str, option: str, whole: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"{option} {whole}: {text!r} is not a number") from None


def choose_tasks(
    messages: Iterable[str],
    rates_hz: dict[str, float],
    offsets_ms: dict[str, float],
    rng: np.random.Generator,
) -> dict[str, Task]:
    """One task per message: given rates and offsets, else the default rate and 0.5..5 ms."""
    rates_hz, tasks = DEFAULT_RATES_HZ | rates_hz, {}
    messages = tuple(messages)
    for name in {**rates_hz, **offsets_ms}:
        if name not in messages and name not in DEFAULT_RATES_HZ:
            raise typer.BadParameter(f"{name}: no such message among {', '.join(messages)}")
    for message in messages:
        drawn_ms = rng.uniform(0.5, 5.0)  # drawn in any case: one given offset moves no other
        if message not in rates_hz:
            raise typer.BadParameter(f"--rate {message}=HZ is needed")
        tasks[message] = Task(rates_hz[message], offsets_ms.get(message, drawn_ms) * 1e-3)
    return tasks


def describe(tasks: dict[str, Task]) -> dict[str, Any]:
    """What the estimator is to find: per message its rate and the true age of its values."""
    mean_wait_s = 0.5e-6 * ARBITRATION_US
    return {
        name: {
            "rate_hz": task.rate_hz,
            "offset_s": task.offset_s,
            "mean_age_s": task.offset_s + mean_wait_s,  # at the stamp, with the wait for the bus
        }
        for name, task in tasks.items()
    }


def main(
    table: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Parquet or CSV.")],
    out: Annotated[Path, typer.Argument(help="CAN log to write: .blf or .log (candump).")],
    mode: Annotated[Mode, typer.Option(help="One cycle per row, or a task per message.")] = (
        Mode.CYCLE
    ),
    dbc: Annotated[Path, typer.Option(help="DBC that defines the messages.")] = CONTROLLER_DBC,
    route: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            help="column=Message.Signal[*factor][:held], repeated; held: a command.  Without it "
            "the columns u, x_ref, p_tank, p_a, p_b, p_supply, x, v go to rtid's own DBC.",
        ),
    ] = None,
    rate: Annotated[
        list[str] | None,
        typer.Option(
            help="Message=Hz (multirate), repeated.  ValveCommand=100, Pressures=200, Motion=50."
        ),
    ] = None,
    offset: Annotated[
        list[str] | None,
        typer.Option(help="Message=ms: age of its values (multirate).  Drawn from 0.5..5 ms."),
    ] = None,
    jitter: Annotated[
        float, typer.Option(help="Standard deviation of a task's instant, in periods (multirate).")
    ] = round(float(TASK_JITTER), 5),
    jitter_us: Annotated[float, typer.Option(help="Mean wait for the bus (cycle).")] = 20.0,
    seed: Annotated[int, typer.Option(help="The same seed gives the same log.")] = 0,
    time_column: Annotated[str, typer.Option(help="Column with the time in seconds.")] = "t",
) -> None:
    """Turn a table of a recorded machine into a CAN log, with realistic timing."""
    columns = read_table(table)
    routes = parse_routes(route or ()) or {
        name: chosen for name, chosen in CONTROLLER_ROUTES.items() if name in columns
    }
    absent = ({time_column} | set(routes)) - set(columns)
    if absent or not routes:
        raise typer.BadParameter(f"{table} has no column {', '.join(sorted(absent)) or 'to send'}")
    rng, catalog = np.random.default_rng(seed), load(dbc)
    t_us = START_US + np.rint(columns[time_column] * 1e6).astype(np.int64)
    truth: dict[str, Any] = {"table": table.name, "mode": mode, "seed": seed, "start_us": START_US}
    if mode is Mode.CYCLE:
        frames = cycle_frames(catalog, routes, columns, t_us, rng, jitter_us)
        truth |= {"jitter_us": jitter_us}
    else:
        given = parse_values(rate or (), "--rate"), parse_values(offset or (), "--offset")
        tasks = choose_tasks(messages_of(routes), *given, rng)
        frames = multirate_frames(catalog, routes, columns, t_us, tasks, rng, jitter)
        truth |= {"jitter_periods": jitter, "messages": describe(tasks)}
    write_log(out, frames)
    out.with_suffix(".json").write_text(json.dumps(truth, indent=1) + "\n")
    print(f"{out}: {len(frames)} frames")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(epilog=__doc__)(main)
    app()
