"""What the traces of a fleet add up to: a map per machine, and what is typical of its type.

Machines of one type have the same declaration (the project's digest).  A machine's map comes from
the sums of all its traces; the typical map is the median over machines, its spread the scaled
median deviation; a machine is an outlier by the rms of its deviations in units of that spread.
"""

from __future__ import annotations

import csv
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import reduce
from multiprocessing import get_context
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from rtid.estimator.flowmap import PRIOR, SHUT, VALID, EdgeMap, FlowMap
from rtid.estimator.published import publish
from rtid.estimator.solution import Solution, solve
from rtid.fleet.archive import Archive
from rtid.maps.files import columns, provenance, unusual_units, write_map
from rtid.model import Machine
from rtid.plain import FloatArray

FEWEST = 3  # machines that a typical value takes
MAD = 1.4826  # of a normal distribution
FLOOR = 1e-3  # least spread, of the largest flow: maps are not known better
WORST = ("unknown", "missing", "ambiguous", "insufficient_data", "", "matches")

Row = Mapping[str, Any]


@dataclass(frozen=True)
class FleetMachine:
    """All traces of a machine of one declaration: its rows, and the joint estimate."""

    name: str
    digest: str
    rows: tuple[Row, ...]
    solution: Solution
    flowmap: FlowMap

    @property
    def verdict(self) -> str:
        """The worst of its newest three traces that have one: what there is now."""
        newest = [row["verdict"] for row in self.rows if row["verdict"]][-3:]
        return min(newest, key=WORST.index, default="")

    @property
    def effects(self) -> list[str]:
        """Effects that were named, the most frequent first."""
        return [e for e, _ in Counter(e for r in self.rows for e in r["effects"]).most_common()]


@dataclass(frozen=True, eq=False)
class Typical:
    """Typical flows (points,) of a type at the nodes of its grids, and their spread, m3/s."""

    digest: str
    edge: list[str]
    u_v: FloatArray
    dp_pa: FloatArray
    flow_m3s: FloatArray
    spread_m3s: FloatArray
    machines: int
    flowmap: FlowMap  # the same as a prior for the next machine, see `_middle`
    units: dict[str, str]  # see `rtid.maps.files.unusual_units`


def machines(
    archive: Archive, models: Mapping[str, Machine], workers: int = 1
) -> list[FleetMachine]:
    """Every machine with at least one trace that was learned from; models by digest.

    workers: processes; a machine takes some seconds, as long as a few of its traces.
    """
    rows: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in archive.rows():
        if not row["error"] and row["digest"] in models:
            rows[row["machine"], row["digest"]].append(row)
    of = [(archive, models[d], name, d, machine_rows) for (name, d), machine_rows in rows.items()]
    if min(workers, len(of)) < 2:
        return [_machine(*parts) for parts in of]
    with ProcessPoolExecutor(min(workers, len(of)), get_context("spawn")) as pool:
        return list(pool.map(_machine, *zip(*of, strict=True)))


def _machine(
    archive: Archive, model: Machine, name: str, digest: str, rows: Sequence[Row]
) -> FleetMachine:
    solution = solve(model, reduce(add, archive.sums([row["key"] for row in rows])))
    return FleetMachine(name, digest, tuple(rows), solution, publish(solution))


def typical(fleet_machines: Iterable[FleetMachine]) -> list[Typical]:
    """One typical map per declaration with at least three machines."""
    types: dict[str, list[FleetMachine]] = defaultdict(list)
    for machine in fleet_machines:
        types[machine.digest].append(machine)
    return [_typical(digest, alike) for digest, alike in types.items() if len(alike) >= FEWEST]


def _typical(digest: str, alike: Sequence[FleetMachine]) -> Typical:
    edge, u, dp = _nodes(alike[0].flowmap)
    flows = np.array([_known(machine.flowmap) for machine in alike])
    enough = np.isfinite(flows).sum(axis=0) >= FEWEST
    flows = flows[:, enough]
    middle = np.nanmedian(flows, axis=0)
    spread = MAD * np.nanmedian(np.abs(flows - middle), axis=0)
    least = FLOOR * float(np.abs(middle).max(initial=0.0))
    names = [name for name, is_known in zip(edge, enough, strict=True) if is_known]
    spread = np.maximum(spread, least)
    flowmap = _middle([machine.flowmap for machine in alike])
    units = unusual_units(alike[0].solution.model)
    return Typical(digest, names, u[enough], dp[enough], middle, spread, len(alike), flowmap, units)


def _middle(maps: Sequence[FlowMap]) -> FlowMap:
    """The median of the maps' terms, with the machines' spread as covariance.

    Of each cell over those machines that have it valid, if they are enough; else over all, and
    then their own uncertainty comes on top.
    """
    edges = []
    for alike in zip(*(m.edges for m in maps), strict=True):
        theta = np.stack([e.theta for e in alike])
        valid = np.stack([e.status == VALID for e in alike])
        enough = valid.sum(axis=0) >= FEWEST
        counted = np.where((valid | ~enough)[..., None], theta, np.nan)
        middle = np.nanmedian(counted, axis=0)
        spread = MAD * np.nanmedian(np.abs(counted - middle), axis=0)
        spread[..., 0] = np.maximum(
            spread[..., 0], FLOOR * np.abs(middle[enough][:, 0]).max(initial=0.0)
        )
        cov = spread[..., :, None] * np.eye(spread.shape[-1])
        cov = cov * spread[..., None, :]
        cov[~enough] += np.mean([e.cov[~enough] for e in alike], axis=0)
        status = np.where(enough, VALID, PRIOR)
        status = np.where(alike[0].status == SHUT, SHUT, status)
        edges.append(replace(alike[0], theta=middle, cov=cov, status=status, reason={}))
    return FlowMap(tuple(edges))


def deviation(machine: FleetMachine, of: Typical) -> float:
    """Rms of what a machine's map deviates from the typical one, in units of the spread."""
    values = dict(
        zip(zip(*_nodes(machine.flowmap), strict=True), _known(machine.flowmap), strict=True)
    )
    at = zip(of.edge, of.u_v, of.dp_pa, strict=True)
    off = (np.array([values[node] for node in at]) - of.flow_m3s) / of.spread_m3s
    off = off[np.isfinite(off)]
    return float(np.sqrt(np.mean(off**2))) if len(off) else float("nan")


def _nodes(flowmap: FlowMap) -> tuple[list[str], FloatArray, FloatArray]:
    """Edge, command and pressure drop of all centres of blocks."""
    names = [edge.name for edge in flowmap.edges for _ in range(edge.status.size)]
    u, dp = np.concatenate([_centres(edge).reshape(2, -1) for edge in flowmap.edges], axis=1)
    return names, u, dp


def _known(flowmap: FlowMap) -> FloatArray:
    """Flow at these centres, NaN in blocks that do not stand on their own data."""
    flows = (np.where(e.status == VALID, e.flow(*_centres(e)), np.nan) for e in flowmap.edges)
    return np.concatenate([flow.ravel() for flow in flows])


def _centres(edge: EdgeMap) -> FloatArray:
    """Command and pressure drop (2, u, dp) in the middle of every block."""
    centres = [0.5 * (b[1:] + b[:-1]) for b in (edge.grid.u_v, edge.grid.dp_pa)]
    return np.stack(np.meshgrid(*centres, indexing="ij"))


def write(
    archive: Archive, fleet_machines: Sequence[FleetMachine], types: Sequence[Typical]
) -> None:
    """Maps, typical maps and the table of machines, the most remarkable first."""
    for machine in fleet_machines:
        traces = f"{len(machine.rows)} traces of {machine.name}"
        origin = provenance(machine.solution, machine.name, machine.digest, traces)
        path = archive.folder / "maps" / f"{_plain(machine.name)}-{machine.digest[:8]}.npz"
        write_map(path, machine.flowmap, origin)
    for item in types:
        path = archive.folder / f"typical-{item.digest[:8]}.npz"
        _write_typical(path.with_suffix(".csv"), item)
        origin = {"digest": item.digest, "machines": item.machines, **item.units}
        write_map(path, item.flowmap, origin)
    archive.keep_machines(ranked(fleet_machines, types))


def ranked(
    fleet_machines: Sequence[FleetMachine], types: Sequence[Typical]
) -> list[dict[str, Any]]:
    """One row per machine: the worst verdict first, then the largest deviation from its type."""
    of = {item.digest: item for item in types}
    rows = [
        {
            "machine": machine.name,
            "digest": machine.digest,
            "traces": len(machine.rows),
            "verdict": machine.verdict,
            "effects": machine.effects,
            "deviation": deviation(machine, of[machine.digest])
            if machine.digest in of
            else float("nan"),
            "beta_pa": machine.solution.beta_pa.tolist(),
            "beta_sd_pa": machine.solution.beta_sd_pa.tolist(),
            "valid_blocks": int(sum((e.status == VALID).sum() for e in machine.flowmap.edges)),
            "rho": float(machine.solution.rho),
        }
        for machine in fleet_machines
    ]
    return sorted(rows, key=lambda r: (WORST.index(r["verdict"]), -np.nan_to_num(r["deviation"])))


def _plain(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)


def _write_typical(path: Path, item: Typical) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(f"# typical of {item.machines} machines; sd: spread over them\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns(item.units))
        values = item.edge, item.u_v, item.dp_pa, item.flow_m3s, item.spread_m3s
        for name, u, dp, q, sd in zip(*values, strict=True):
            writer.writerow([name, f"{u:.9g}", f"{dp:.9g}", f"{q:.9g}", f"{sd:.3g}", "prior"])
