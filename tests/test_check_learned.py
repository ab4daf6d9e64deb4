"""What `rtid check` says will be learned is what `rtid replay` learns, on records of every kind."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rtid.cli.exits import Exit
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.command import called
from tests.replays import shared_replays  # noqa: F401

RECORDS = {"rich": ("rich", 12.0), "sweep": ("sweep", 12.0), "short": ("rich", 3.0)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of one machine, each with its project; the machine of "standstill" never moves."""
    path = tmp_path_factory.mktemp("records")
    for name, (motion, duration_s) in RECORDS.items():
        write_run(
            path / f"{name}.parquet", simulate(SimulatedPlant(), motion, 3, duration_s), 3, motion
        )
    moving = pq.read_table(path / "short.parquet")
    rows = np.zeros(len(moving), np.int64)
    still = {name: np.asarray(moving[name])[rows] for name in moving.column_names}
    still |= {"t": np.asarray(moving["t"]), "u": 0 * still["u"]}
    table = pa.table([pa.array(still[f.name], f.type) for f in moving.schema], schema=moving.schema)
    pq.write_table(table, path / "standstill.parquet")
    (path / "standstill.toml").write_text((path / "short.toml").read_text())
    return path


@pytest.mark.first_of(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", list(RECORDS))
def test_check_says_what_replay_learns(folder: Path, name: str) -> None:
    """It once took every block with 20 rows for learned: 44 where replay learned one per edge."""
    project, trace = folder / f"{name}.toml", folder / f"{name}.parquet"
    told = json.loads(called("check", project, trace, "--json").stdout)
    replayed = json.loads(called("replay", trace, "-p", project, "--json").stdout)
    valid = {edge: counts.get("valid", 0) for edge, counts in replayed["blocks"].items()}
    assert told["learned"] == valid
    rows = {
        one["edge"]: sum(n >= 20 for line in one["rows"] for n in line) for one in told["coverage"]
    }
    assert all(rows[edge] > valid[edge] for edge in valid), "rows alone promise too much"
    few = {edge for edge, n in valid.items() if n < 4}
    warned = {
        f["subject"].removeprefix("edges.") for f in told["findings"] if "learns" in f["text"]
    }
    assert few <= warned
    text = called("check", project, trace).stdout
    assert f"replay learns {sum(valid.values())} blocks" in text or "Not ready" in text


def test_a_machine_that_stands_is_not_ready(folder: Path) -> None:
    done = called("check", folder / "standstill.toml", folder / "standstill.parquet")
    assert done.returncode == Exit.NEGATIVE
    assert "Not ready" in done.stdout and "never opens" in done.stdout


def test_a_grid_too_coarse_for_the_valve_is_named(folder: Path) -> None:
    """One block over all commands and one over all drops: the flow bends more than it can."""
    project = folder / "coarse.toml"
    lines = (folder / "rich.toml").read_text().splitlines()
    grids = {"u_grid_v": "[1.0, 5.5, 10.0]", "dp_grid_mpa": "[-0.3, 10.0]"}
    coarse = [f"{k} = {grids[k]}" if (k := line.split(" ")[0]) in grids else line for line in lines]
    project.write_text("\n".join(coarse))
    done = called("check", project, folder / "rich.parquet", "--json")
    found = json.loads(done.stdout)["findings"]
    coarse_edges = [f for f in found if "the grid is too coarse for the valve" in f["text"]]
    assert coarse_edges, done.stdout[-2000:]
    assert "narrower steps" in coarse_edges[0]["remedy"]
