"""Exported FMUs, opened and run by FMPy: the free run to 1e-6, and learned from again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from firmware_bridge.lookup import STATUS
from rtid.compare.motion import smooth_position
from rtid.errors import RtidError
from rtid.maps.fmu import VERSIONS, Dynamics, write_fmu
from rtid.model import Machine, Term
from rtid.plain import FloatArray
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.study import Study
from tests.command import ends
from tests.test_free_run import TERMS, THETA_TERMS, machine, run, signals

fmpy = pytest.importorskip("fmpy", reason="pip install 'rtid[dev]'")
read_model_description, simulate_fmu, extract = (
    fmpy.read_model_description, fmpy.simulate_fmu, fmpy.extract
)  # fmt: skip
validate_fmu = pytest.importorskip("fmpy.validation").validate_fmu
COMPLIANCE = np.array([1 / 800e6, 1 / 900e6])
ORIGIN = {"project": "here", "rows": 7}


def inputs(model: Machine, chunk: FloatArray, pressures: bool = False) -> np.ndarray:
    """A record as FMPy takes it: signals at its samples, and their rates up to the next one."""
    t, values = chunk[:, 0], chunk[:, 2:]
    steps = np.diff(values, axis=0, append=values[-1:]) / np.diff(t, append=t[-1] + 1.0)[:, None]
    columns = {"time": t}
    for k, signal in enumerate(model.signals):
        if signal.name == "v" or (not pressures and signal.name in ("p_a", "p_b")):
            continue
        columns[signal.name] = values[:, k]
        if not pressures and signal.name != "u":
            columns[f"{signal.name}_rate"] = steps[:, k]
    kinds = [(name, float) for name in columns]
    return np.array(list(zip(*columns.values(), strict=True)), kinds)


def simulated(path: Path, model: Machine, chunk: FloatArray) -> np.ndarray:
    step = float(chunk[1, 0] - chunk[0, 0])
    start = {"p_a": chunk[0, 3], "p_b": chunk[0, 4]}
    return simulate_fmu(
        str(path), start_time=chunk[0, 0], stop_time=chunk[-1, 0], step_size=step,
        output_interval=step, input=inputs(model, chunk), start_values=start,
    )  # fmt: skip


@pytest.mark.first_of(2)
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(("terms", "lag_s"), [((), 0.0), (TERMS, 1.3e-3)])
def test_the_fmu_is_the_free_run(
    tmp_path: Path, version: int, terms: tuple[Term, ...], lag_s: float
) -> None:
    model, flowmap = machine(terms, lag_s)
    chunk, path = signals(200), tmp_path / "machine.fmu"
    dynamics = Dynamics(COMPLIANCE, THETA_TERMS[: len(terms)], lag_s)
    assert write_fmu(path, model, flowmap, dynamics, ORIGIN, version)
    assert validate_fmu(str(path)) == []
    described = read_model_description(str(path))
    units = {v.name: v.unit for v in described.modelVariables}
    assert units["p_a"] == units["beta_a"] == "Pa" and units["Q_pa_low"] == "m3/s"
    got = simulated(path, model, chunk)
    wanted, _ = run(model, flowmap, chunk)
    for k, name in enumerate(("p_a", "p_b")):
        assert np.abs(got[name] - wanted[:, k]).max() < 1e-6 * wanted.max()
    assert (got["status"][1:] == 1).all()
    assert 20 < (got["status_pa"] == 0).sum() < 180


@pytest.mark.parametrize("version", VERSIONS)
def test_the_map_alone_tells_flow_interval_and_what_it_stands_on(
    tmp_path: Path, version: int
) -> None:
    model, flowmap = machine()
    edges = []
    for edge in flowmap.edges:
        cov = np.broadcast_to(1e-14 * np.diag([4.0, 1, 1, 0, 0, 0]), edge.cov.shape).copy()
        status = edge.status.astype("<U12")
        status[:, 0] = "prior"
        edges.append(
            type(edge)(edge.name, edge.grid, edge.safe_band_v, edge.theta, cov, status, {})
        )
    flowmap = type(flowmap)(tuple(edges))
    path, chunk = tmp_path / "map.fmu", signals(100)
    chunk[:, 3] = np.linspace(1e6, 7e6, len(chunk))
    assert write_fmu(path, model, flowmap, None, ORIGIN, version)
    assert validate_fmu(str(path)) == []
    got = simulate_fmu(
        str(path), stop_time=chunk[-1, 0], step_size=1e-3, output_interval=1e-3,
        input=inputs(model, chunk, pressures=True),
    )  # fmt: skip
    at = np.arange(1, len(chunk)) - 1  # inputs of a step's beginning
    u, dp = chunk[at, 2], chunk[at, 5] - chunk[at, 3]
    flow, sd = flowmap["pa"].flow(u, dp), flowmap["pa"].sd(u, dp)
    inside = np.isfinite(flow)
    assert inside.sum() > 50
    np.testing.assert_allclose(got["Q_pa"][1:][inside], flow[inside], atol=1e-12)
    width = (got["Q_pa_high"] - got["Q_pa_low"])[1:][inside]
    assert np.abs(width - 2 * 1.96 * sd[inside]).max() < 0.05 * sd.max() * 3.92
    words = flowmap["pa"].status_at(u, dp)
    codes = np.array([STATUS.index(word) for word in words])
    assert (got["status_pa"][1:] == codes).mean() > 0.98  # but at borders, in float32
    assert {0, 1, 4} <= set(codes)


def test_bad_wishes_are_named_and_nothing_is_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, flowmap = machine()
    path = tmp_path / "x.fmu"
    for dynamics, version, reason in (
        (Dynamics(np.array([0.0, 1e-9]), np.zeros(0), 0.0), 2, "bulk modulus"),
        (None, 1, "FMI 1"),
    ):
        with pytest.raises(RtidError, match=reason):
            write_fmu(path, model, flowmap, dynamics, ORIGIN, version)
    monkeypatch.setattr(shutil, "which", lambda name: "/bin/false")
    with pytest.raises(RtidError, match="cannot compile"):
        write_fmu(path, model, flowmap, None, ORIGIN)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert not write_fmu(path, model, flowmap, None, ORIGIN)
    with ZipFile(path) as archive:
        names = archive.namelist()
        assert json.loads(archive.read("resources/provenance.json")) == ORIGIN
    assert "sources/rtid_fmi.c" in names and not any(n.startswith("binaries") for n in names)


def driven(path: Path, names: list[str], rows: FloatArray, start: list[float]) -> FloatArray:
    """p_a and p_b (n, 2) of an FMU that is stepped by hand: inputs of each row (n, names)."""
    from fmpy.fmi2 import FMU2Slave

    described = read_model_description(str(path))
    at = {v.name: v.valueReference for v in described.modelVariables}
    unit = FMU2Slave(
        guid=described.guid, unzipDirectory=extract(str(path), str(path.with_suffix(""))),
        modelIdentifier=described.coSimulation.modelIdentifier,
    )  # fmt: skip
    unit.instantiate()
    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.setReal([at["p_a"], at["p_b"]], start)
    unit.exitInitializationMode()
    out, inputs_at = np.empty((len(rows), 2)), [at[name] for name in names]
    out[0] = start
    for k, row in enumerate(rows[:-1].tolist()):
        unit.setReal(inputs_at, row)
        unit.doStep(1e-3 * k, 1e-3)
        out[k + 1] = unit.getReal([at["p_a"], at["p_b"]])
    unit.terminate()
    unit.freeInstance()
    return out


@pytest.mark.long
@pytest.mark.slow  # two records are learned
def test_a_log_from_the_fmu_gives_the_same_maps_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`rtid export`, the record's inputs through the FMU, 500 Pa of noise, and learned again."""
    run_ = simulate(SimulatedPlant(), "rich", 0, 40.0)
    write_run(tmp_path / "run.parquet", run_, 0, "rich")
    project, path = tmp_path / "run.toml", tmp_path / "machine.fmu"
    assert ends("export", tmp_path / "run.parquet", path, "-p", project) == 0, capsys.readouterr()
    table = pyarrow.parquet.read_table(tmp_path / "run.parquet")
    before = Study(project, tmp_path / "run.parquet")
    x = smooth_position(before.machine, before.replay.chunk)
    columns = {"u": table["u"].to_numpy(), "x": x, "x_rate": np.diff(x, append=x[-1]) / 1e-3}
    columns |= {name: table[name].to_numpy() for name in ("p_supply", "p_tank")}
    rows = np.column_stack(list(columns.values()))
    start = [float(table[name][0].as_py()) for name in ("p_a", "p_b")]
    pressures = driven(path, list(columns), rows, start)
    rng = np.random.default_rng(1)
    noisy = {"p_a": pressures[:, 0], "p_b": pressures[:, 1]}
    noisy = {name: column + rng.normal(0, 500.0, len(x)) for name, column in noisy.items()}
    for name, column in (noisy | {"x": x + rng.normal(0, 1e-6, len(x))}).items():
        k = table.column_names.index(name)
        table = table.set_column(k, table.schema.field(name), pa.array(column))
    pyarrow.parquet.write_table(table, tmp_path / "again.parquet")
    after = Study(project, tmp_path / "again.parquet")
    for edge, other in zip(before.map.edges, after.map.edges, strict=True):
        u = np.linspace(edge.grid.u_v[0], edge.grid.u_v[-1], 60)[:, None]
        dp = np.linspace(edge.grid.dp_pa[0], edge.grid.dp_pa[-1], 60)[None, :]
        valid = (edge.status_at(u, dp) == "valid") & (other.status_at(u, dp) == "valid")
        flow = edge.flow(u, dp)
        assert valid.sum() > 200
        assert np.abs(flow - other.flow(u, dp))[valid].max() < 1e-3 * np.nanmax(np.abs(flow))
