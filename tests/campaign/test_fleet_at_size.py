"""A fleet of 2,000 traces of 20 s, one per machine and round broken, killed half way and resumed.

RTID_FLEET_TRACES=400 make campaign      # fewer, where half an hour is too long
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rtid.fleet.archive import Archive
from rtid.fleet.traces import find
from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import SimulationError, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.campaign.report import leave

pytestmark = pytest.mark.campaign
pytest.importorskip("distributed", reason="pip install 'rtid[fleet]'")

MACHINES, WORN, LEAK = 20, (4, 13), "internal_leakage_laminar"
TRACES = int(os.environ.get("RTID_FLEET_TRACES", "2000"))
WORKERS = 2
BASIS = f"{TRACES} traces of 20 s of {MACHINES} random machines, with diagnosis"


@dataclass(frozen=True)
class Size:
    """A fleet that was killed half way and resumed; rows in the order in which they were done."""

    folder: Path
    rows: list[dict[str, object]]
    done_s: list[float]
    broken: set[str]


def record(folder: Path, number: int, seed: int) -> None:
    """One trace of a machine; the first one brings the project file."""
    plant: SimulatedPlant = draw(900 + number)
    machine = hide_wish(plant, f"{LEAK}=middle") if number in WORN else plant
    path = folder / f"t{seed:04d}.parquet"
    run = simulate(machine, "rich" if seed % 2 else "rich_record", 1000 * number + seed, 20.0)
    write_run(path, run, seed, "rich")
    described = path.with_suffix(".toml")
    described.rename(folder / "project.toml")


def spoil(path: Path, way: int) -> None:
    """Cut it, fill it with noise, or empty it."""
    whole = path.read_bytes()
    noise = np.random.default_rng(int.from_bytes(path.parent.name.encode())).bytes(5000)
    path.write_bytes((whole[: len(whole) // 2], noise, b"")[way % 3])


def made(root: Path) -> set[str]:
    """The traces; which of them are broken, one per machine."""
    broken = set()
    for number in range(MACHINES):
        folder = root / f"m{number:02d}"
        folder.mkdir(parents=True)
        seed = 0
        while len(list(folder.glob("*.parquet"))) < TRACES // MACHINES:
            seed += 1
            try:
                record(folder, number, seed)
            except SimulationError:  # this motion asks more than the machine can
                continue
        worst = sorted(folder.glob("*.parquet"))[1]
        spoil(worst, number)
        broken.add(str(worst.resolve()))
    return broken


def call(root: Path, output: Path, workers: int) -> list[str]:
    words = ["fleet", str(root), "-o", str(output), "--workers", str(workers), "--json"]
    return [sys.executable, "-m", "rtid", *words]


def finished(archive: Path) -> list[Path]:
    """Rows in the order in which they were done; what begins with a dot is being written."""
    rows = (archive / "runs").glob("machine=*/[!.]*.parquet")
    return sorted(rows, key=lambda path: path.stat().st_mtime)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Size:
    root, output = tmp_path_factory.mktemp("traces"), tmp_path_factory.mktemp("results")
    broken = made(root)
    first = subprocess.Popen(
        call(root, output, WORKERS), stdout=subprocess.DEVNULL, start_new_session=True
    )
    while len(finished(output)) < TRACES // 2:
        assert first.poll() is None, "it ended before half of the traces"
        time.sleep(0.2)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    subprocess.run(call(root, output, WORKERS), stdout=subprocess.DEVNULL, check=True)
    archive = Archive(output)
    done_s = {path.stem: path.stat().st_mtime for path in finished(output)}
    rows = sorted(archive.rows(), key=lambda row: done_s[row["key"]])
    return Size(root, rows, [done_s[row["key"]] for row in rows], broken)


def test_every_trace_is_there_once(fleet: Size) -> None:
    wanted = {str(job.trace) for job in find([fleet.folder], None)[0]}
    found = [row["trace"] for row in fleet.rows]
    leave("Fleet killed half way and resumed: traces twice, missing",
          f"{len(found) - len(set(found))}, {len(wanted - set(found))}", "0, 0", BASIS)  # fmt: skip
    assert sorted(wanted) == sorted(str(name) for name in found)
    assert len(found) == TRACES


def test_each_broken_trace_has_its_error(fleet: Size) -> None:
    refused = {row["trace"]: row["error"] for row in fleet.rows if row["error"]}
    leave("Fleet: named errors", f"{len(refused)}", f"{len(fleet.broken)} broken traces", BASIS)
    assert set(refused) == fleet.broken
    assert all(str(Path(str(name)).name) in str(why) for name, why in refused.items())


def test_the_cost_per_trace_stays(fleet: Size) -> None:
    """Processor time of the last sixth of the traces over that of the first."""
    cost = np.array([row["cpu_s"] for row in fleet.rows if not row["error"]], float)
    sixths = [float(np.median(part)) for part in np.array_split(cost, 6)]
    leave("Fleet: cost of a trace by sixths of the run, s",
          ", ".join(f"{s:.2f}" for s in sixths), "constant", BASIS)  # fmt: skip
    assert sixths[-1] == pytest.approx(sixths[0], rel=0.15)


def test_the_worn_machines_stand_out(fleet: Size) -> None:
    """By the majority of their traces' verdicts that name something; healthy ones by none."""
    worn = {f"m{number:02d}" for number in WORN}
    named = {row["machine"] for row in fleet.rows if row["verdict"] in ("missing", "ambiguous")}
    leave("Fleet: machines with a missing effect", ", ".join(sorted(map(str, named))),
          ", ".join(sorted(worn)), BASIS)  # fmt: skip
    assert named == worn
