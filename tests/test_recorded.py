"""A record with what was learned from it as MDF 4 and MCAP, read by asammdf and mcap."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.sources import read_table
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.compared import compare_trace
from rtid.study.study import Study
from rtid.tell.recorded import groups_of, write_recorded
from rtid.trace.snapshot import save as save_snapshot
from tests.command import said
from tests.replays import shared_replays  # noqa: F401

ORIGIN = {"project": "here"}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Study]:
    folder = tmp_path_factory.mktemp("recorded")
    write_run(folder / "run.parquet", simulate(SimulatedPlant(), "rich", 0, 12.0), 0, "rich")
    yield Study(folder / "run.toml", folder / "run.parquet")


def test_asammdf_reads_residual_block_status_and_estimates(study: Study, tmp_path: Path) -> None:
    path = tmp_path / "out.mf4"
    write_recorded(path, study, ORIGIN)
    from asammdf import MDF

    parts = compare_trace(study.replay).held[0].parts.values()
    with MDF(path) as log:
        found = log.get("residual_a")
        assert found.unit == "m3/s"
        np.testing.assert_allclose(found.timestamps, np.concatenate([p.t_s for p in parts]))
        np.testing.assert_array_equal(
            found.samples, np.concatenate([p.residual_m3s[:, 0] for p in parts])
        )
        status, block = log.get("status_pa").samples, log.get("block_pa").samples
        assert {0, 1} <= set(status) <= set(range(6)) and (status[block < 0] == 1).all()
        beta, sd = (log.get(name).samples[0] for name in ("beta_a", "beta_a_sd"))
        assert beta == study.fit.solution.beta_pa[0] and 0 < sd < 0.1 * beta
        pressure = log.get("p_a")
        assert pressure.unit == "Pa" and len(pressure.samples) == len(study.trace.samples.t_us)
    assert "residual_a" in read_table(path).columns
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_mcap_reads_the_same_and_the_decoded_signals(study: Study, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path = tmp_path / "out.mcap"
    write_recorded(path, study, ORIGIN)
    groups = {group.name: group for group in groups_of(study)}
    told: dict[str, list[tuple[int, dict[str, float]]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and schema.name.endswith(channel.topic.rpartition("/")[2])
            told.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
            stated = json.loads(schema.data)["properties"]
        assert {m.metadata["provenance"] for m in reader.iter_metadata()} == {json.dumps(ORIGIN)}
    assert stated
    for name, group in groups.items():
        rows = told[f"/rtid/{name}"]
        assert len(rows) == len(group.t_s)
        stamps = np.array([stamp for stamp, _ in rows])
        start = int(study.trace.samples.t_us[0]) * 1000
        np.testing.assert_allclose(1e-9 * (stamps - start), group.t_s, atol=1e-6)
        for key, channel in group.channels.items():
            values = [row.get(key, np.nan) for _, row in rows]
            np.testing.assert_array_equal(values, channel.values)


def test_a_missing_library_and_a_snapshot_are_refused_in_words(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(RtidError, match="needs mcap"):
        write_recorded(tmp_path / "out.mcap", study, ORIGIN)
    snapshot, empty, project = tmp_path / "run.npz", tmp_path / "empty.npz", study.project
    save_snapshot(snapshot, study.replay.live, project.digest)
    save_snapshot(empty, Estimator(project.model), project.digest)
    for source, output, words, reason in (
        (snapshot, "out.mf4", [], "export from a trace"),
        (snapshot, "out.fmu", ["--fmi", "1"], "no FMI 1"),
        (empty, "out.fmu", [], "no block of its maps stands on data"),
    ):
        code, _, err = said("export", source, tmp_path / output, "-p", project.path, *words)
        assert code and reason in " ".join(err.split())
    assert {p.name for p in tmp_path.iterdir()} == {"run.npz", "empty.npz"}
