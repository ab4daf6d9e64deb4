"""A fleet: every trace once, errors as rows, sums that add up, typical maps and the odd machine."""

from __future__ import annotations

from functools import reduce
from operator import add
from pathlib import Path
from shutil import copy

import numpy as np
import pyarrow.parquet as pq
import pytest

from firmware_bridge.samples import join
from rtid.cli.exits import Exit
from rtid.compare.reference import ReferenceMap
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import VALID
from rtid.estimator.solution import solve
from rtid.estimator.sums import Sums
from rtid.fleet.archive import Archive
from rtid.fleet.learning import Outcome, outcome, packed, unpacked
from rtid.fleet.merging import FEWEST, deviation, machines, ranked, typical
from rtid.fleet.running import run
from rtid.fleet.traces import find
from rtid.maps.datasheet import read_reference
from rtid.maps.files import read_map
from rtid.maps.prior_map import SHARE_OF_TYPICAL, find_prior, with_prior
from rtid.plain import FloatArray
from rtid.project import load
from rtid.tell.fleet import tell
from rtid.trace.reading import read_trace
from tests.command import ends, in_json
from tests.eighty import eighty  # noqa: F401
from tests.fleet.conftest import MACHINES, WORN

pytest.importorskip("distributed", reason="pip install 'rtid[fleet]'")


@pytest.fixture(scope="session")
def outcomes(traces: Path, project: Path) -> list[Outcome]:
    """All traces learned from, in this process."""
    return [outcome(job, False) for job in find([traces / "traces"], project)[0]]


@pytest.fixture(scope="session")
def learned(outcomes: list[Outcome], tmp_path_factory: pytest.TempPathFactory) -> Archive:
    archive = Archive(tmp_path_factory.mktemp("learned"))
    for found in outcomes:
        archive.keep(found)
    return archive


def test_every_trace_is_found_with_its_machine_and_copies_are_left_out(
    traces: Path, project: Path, tmp_path: Path
) -> None:
    jobs, copies = find([traces / "traces"], project)
    assert [job.machine for job in jobs] == [m for m in MACHINES for _ in (0, 1)]
    assert not copies
    again = Path(copy(jobs[0].trace, tmp_path / "again.parquet"))
    jobs, copies = find([traces / "traces", again], project)
    assert len(jobs) == 8 and copies == [again]
    with pytest.raises(RtidError, match="no project file"):
        find([traces / "traces" / "m1"], None)
    broken = [tmp_path / "no.parquet", tmp_path / "none.parquet"]
    for path in broken:
        path.touch()
    jobs, copies = find([traces / "traces", *broken], project)
    assert len(jobs) == 10 and not copies, "each empty file is an error of its own"
    (tmp_path / "empty").mkdir()
    with pytest.raises(RtidError, match="no trace found"):
        find([tmp_path / "empty"], project)


def scaled(sums: Sums) -> FloatArray:
    """Normal equations in units of each column's size, blocks in the order of their cells."""
    normal, order = sums.normal(), np.argsort(sums.cells)
    n = len(normal.right) - 6 * len(order)
    at = np.concatenate([np.arange(n), (n + 6 * order[:, None] + np.arange(6)).ravel()])
    size = np.sqrt(np.maximum(np.diag(normal.gram)[at], 1e-300))
    gram = normal.gram[np.ix_(at, at)] / np.outer(size, size)
    return np.column_stack([gram, normal.right[at] / size / np.sqrt(normal.square)])


def test_merged_sums_are_one_estimate_over_the_concatenation(
    project: Path, learned: Archive
) -> None:
    """To 1e-10: normal equations in either order; in that of time unknowns and flows, too.

    The last innovations, which tell how much of the pressures' noise the maps absorb, are the
    later ones' in a sum as in a record.
    """
    loaded = load(project)
    rows = [row for row in learned.rows() if row["machine"] == "m2"]
    parts = [read_trace(loaded, Path(row["trace"])).samples for row in rows]
    later = parts[1]
    shifted = type(later)(
        later.names, later.t_us + parts[0].t_us[-1] + 10_000_000, later.values, later.flags
    )
    whole = Estimator(loaded.model)
    whole.update(join([parts[0], shifted]))
    keys = [row["key"] for row in rows]
    for order in (keys, keys[::-1]):
        assert np.abs(scaled(reduce(add, learned.sums(order))) - scaled(whole.sums)).max() < 1e-10
    expected, merged = whole.solution(), solve(loaded.model, reduce(add, learned.sums(keys)))
    assert merged.compliance == pytest.approx(expected.compliance, rel=1e-10)
    flows = {(b.edge, b.i, b.j): b.mean_flow_m3s for b in expected.blocks if b.status == "valid"}
    assert len(flows) > 100
    largest = max(abs(q) for q in flows.values())
    for cell, q in flows.items():
        block = merged.block(*cell)
        assert block is not None
        assert abs(block.mean_flow_m3s - q) < 1e-10 * largest


def test_sums_come_back_from_their_bytes(learned: Archive) -> None:
    (first,) = learned.sums([learned.rows()[0]["key"]])
    again = unpacked(packed(first))
    for name in ("shared", "blocks", "pairs", "tiles", "noise", "rows", "compliance", "innovation"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))


@pytest.mark.long
def test_the_worn_machine_stands_out_and_the_typical_map_is_a_reference(
    project: Path, learned: Archive, tmp_path: Path
) -> None:
    loaded = load(project)
    found = machines(learned, {loaded.machine_digest: loaded.model})
    assert [m.name for m in found] == list(MACHINES)
    (typ,) = typical(found)
    assert typ.machines == len(MACHINES) >= FEWEST
    off = {m.name: deviation(m, typ) for m in found}
    assert off[WORN] > 3 * max(off[m] for m in MACHINES if m != WORN)
    assert ranked(found, [typ])[0]["machine"] == WORN
    largest = np.abs(typ.flow_m3s).max()
    one = next(m for m in found if m.name == "m2").flowmap
    own = np.array([one.flow(e, u, dp) for e, u, dp in
                    zip(typ.edge, typ.u_v, typ.dp_pa, strict=True)])  # fmt: skip
    assert np.nanmedian(np.abs(own - typ.flow_m3s)) < 0.01 * largest
    assert np.nanmedian(typ.spread_m3s) < 0.03 * largest


def test_bad_traces_have_named_errors_and_stop_nothing(
    traces: Path, project: Path, tmp_path: Path
) -> None:
    fleet = tmp_path / "fleet" / "m9"
    fleet.mkdir(parents=True)
    whole = (traces / "traces/m1/day0.parquet").read_bytes()
    broken = {
        "cut.parquet": whole[: len(whole) // 2],
        "empty.blf": b"",
        "noise.blf": np.random.default_rng(0).bytes(5000),
        "words.csv": b"not,a,trace\n1,2,3\n",
        "text.asc": b"hello\n",
    }
    for name, content in broken.items():
        (fleet / name).write_bytes(content)
    copy(traces / "traces/m1/day0.parquet", fleet / "good.parquet")
    archive = Archive(tmp_path / "out")
    for job in find([fleet.parent], project)[0]:
        archive.keep(outcome(job, False))
    rows = archive.rows()
    bad = {Path(row["trace"]).name: row["error"] for row in rows if row["error"]}
    assert set(bad) == set(broken)
    assert not [text for text in bad.values() if "defect" in text]
    assert archive.forget_errors() == len(broken)
    assert [Path(row["trace"]).name for row in archive.rows()] == ["good.parquet"]


def test_a_defect_is_a_row_too(
    traces: Path, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("boom")

    monkeypatch.setattr("rtid.study.study.read_trace", broken)
    found = outcome(find([traces / "traces"], project)[0][0], True)
    assert found.row["error"] == "ZeroDivisionError: boom" and "report" in found.row["remedy"]


@pytest.mark.long
def test_a_run_goes_on_where_it_was_stopped(traces: Path, project: Path, tmp_path: Path) -> None:
    """Stopped after three of eight: no trace twice, none missing; workers of their own."""
    jobs = find([traces / "traces"], project)[0]
    archive, done = Archive(tmp_path / "out"), []

    class StoppedError(Exception):
        pass

    def stop(n: int, of: int, last: Outcome) -> None:
        done.append(last.job.key)
        assert of == 8
        if n == 3:
            raise StoppedError

    with pytest.raises(StoppedError):
        run(jobs, archive, stop, workers=2, with_diagnosis=False)
    assert len(archive.done()) == 3

    def count(n: int, of: int, last: Outcome) -> None:
        done.append(last.job.key)
        assert of == 5

    assert run(jobs, archive, count, workers=1, with_diagnosis=False) == 5
    assert sorted(done) == sorted(job.key for job in jobs)
    assert archive.done() == {job.key for job in jobs}
    assert run(jobs, archive, count, workers=2, with_diagnosis=False) == 0


@pytest.mark.usefixtures("eighty")
def test_the_command_ranks_the_machines_and_writes_what_others_read(
    traces: Path,
    project: Path,
    outcomes: list[Outcome],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    archive = Archive(out)
    for found in outcomes:
        is_diagnosed = found.job.machine == WORN and found.job.trace.stem == "day0"
        archive.keep(outcome(found.job, True) if is_diagnosed else found)
    told = in_json("fleet", traces / "traces", "-p", project, "-o", out)
    tell(told, out)
    assert "beta, MPa" in capsys.readouterr().out
    assert told["traces"] == 8 and told["errors"] == []
    assert told["verdicts"] == {"not diagnosed": 7, "matches": 1}  # other gains are other maps
    assert {m["machine"]: m["traces"] for m in told["machines"]} == dict.fromkeys(MACHINES, 2)
    assert pq.read_table(out / "machines.parquet").num_rows == len(MACHINES)
    table = pq.read_table(out / "runs", partitioning="hive")
    assert table.num_rows == 8 and set(table["machine"].to_pylist()) == set(MACHINES)
    maps = sorted((out / "maps").iterdir())
    assert len(maps) == len(MACHINES)
    assert read_map(maps[0])[1]["source"] == "2 traces of m1"
    (typ,) = out.glob("typical-*.csv")
    assert isinstance(read_reference(typ), ReferenceMap)
    prior = find_prior(with_prior(load(project), out))
    assert prior is not None
    assert (prior.name, prior.share) == (typ.stem, SHARE_OF_TYPICAL)
    own = read_map(maps[1])[0]["pa"]
    i, j = np.nonzero((own.status == VALID) & (own.grid.dp_pa[:-1] > 0))
    u, dp = own.grid.u_v, own.grid.dp_pa
    at = 0.5 * (u[i] + u[i + 1]), 0.5 * (dp[j] + dp[j + 1])
    off = np.abs(own.flow(*at) - prior.flowmap["pa"].flow(*at)) / prior.flowmap["pa"].sd(*at)
    assert len(off) > 20 and np.median(off) < 1.5


def test_a_fleet_of_failures_ends_with_input(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "m1").mkdir()
    (tmp_path / "m1" / "bad.blf").write_bytes(b"no log")
    out = tmp_path / "out"
    for job in find([tmp_path / "m1"], project)[0]:
        Archive(out).keep(outcome(job, False))
    assert ends("fleet", tmp_path / "m1", "-p", project, "-o", out) == Exit.INPUT
    assert "bad.blf" in capsys.readouterr().out
