"""Maps as files: what goes out comes back, and a broken file is refused in words."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.maps.datasheet import read_reference
from rtid.maps.files import SCHEMA, TABLE_WRITERS, MapFileError, read_map, write_map
from tests.flow_maps import machine, orifice, solved

PROVENANCE = {"trace": "run.blf", "digest": "abc"}


@pytest.fixture(scope="module")
def flowmap() -> FlowMap:
    model = machine(edges=2)
    return publish(solved(model, orifice, np.random.default_rng(0), rows=80))


@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_round_trip_is_exact(flowmap: FlowMap, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    write_map(path, flowmap, PROVENANCE)
    back, provenance = read_map(path)
    assert provenance == PROVENANCE
    rng = np.random.default_rng(1)
    w, dp = rng.uniform(0, 8, 500), rng.uniform(-0.5e6, 7e6, 500)
    for before, after in zip(flowmap.edges, back.edges, strict=True):
        assert (after.name, after.safe_band_v) == (before.name, before.safe_band_v)
        assert after.reason == before.reason
        np.testing.assert_array_equal(after.status, before.status)
        np.testing.assert_array_equal(after.flow(w, dp), before.flow(w, dp))
        np.testing.assert_array_equal(after.sd(w, dp), before.sd(w, dp))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_a_map_without_safe_band_round_trips(tmp_path: Path, suffix: str) -> None:
    model = machine(safe_band_v=-np.inf)
    flowmap = publish(solved(model, orifice, np.random.default_rng(0)))
    write_map(tmp_path / f"map{suffix}", flowmap, {})
    assert read_map(tmp_path / f"map{suffix}")[0][0].safe_band_v == -np.inf


@pytest.mark.parametrize("suffix", TABLE_WRITERS)
def test_a_format_that_cannot_say_the_unit_of_a_rate_is_refused(
    flowmap: FlowMap, tmp_path: Path, suffix: str
) -> None:
    with pytest.raises(MapFileError, match="the map is in m/s"):
        write_map(tmp_path / f"map{suffix}", flowmap, PROVENANCE | {"flow_unit": "m/s"})
    assert not list(tmp_path.iterdir())


def test_json_says_what_it_holds(flowmap: FlowMap, tmp_path: Path) -> None:
    write_map(tmp_path / "map.json", flowmap, PROVENANCE)
    content = json.loads((tmp_path / "map.json").read_text())
    assert content["schema"] == SCHEMA
    assert content["units"]["theta_m3s"] == "m3/s"
    valid = np.array(content["edges"][0]["valid"])
    np.testing.assert_array_equal(valid, flowmap[0].status == "valid")


def test_csv_is_the_map_at_nodes_and_centres(flowmap: FlowMap, tmp_path: Path) -> None:
    write_map(tmp_path / "map.csv", flowmap, PROVENANCE)
    with (tmp_path / "map.csv").open() as file:
        assert file.readline().startswith(f"# {SCHEMA}")
        rows = list(csv.DictReader(file))
    nu, nd = flowmap[0].grid.shape
    assert len(rows) == 2 * (2 * nu + 1) * (2 * nd + 1)
    for row in rows[7::97]:
        q = flowmap.flow(row["edge"], float(row["u_V"]), float(row["dp_Pa"]))
        assert float(row["Q_m3/s"]) == pytest.approx(float(q), rel=1e-6, abs=1e-15)


def test_a_csv_over_a_second_quantity_serves_as_reference_map(tmp_path: Path) -> None:
    """A rate may be over a speed that changes its sign, and is no gain times a root of it."""
    lines = [f"f,{u},{v},{u + 10 * v}" for u in (-2, 0, 2) for v in (-1, 0, 1)]
    (tmp_path / "rate.csv").write_text("\n".join(["edge,u_%,over_m/s,Q_m/s2", *lines]))
    flow = read_reference(tmp_path / "rate.csv").flow("f", [-1, 1.5, 0, 3], [-0.5, 0.25, 2, 0])
    np.testing.assert_allclose(flow, [-6, 4, 10, np.nan])


def test_exported_csv_serves_as_reference_map(flowmap: FlowMap, tmp_path: Path) -> None:
    write_map(tmp_path / "map.csv", flowmap, {})
    sheet = read_reference(tmp_path / "map.csv")
    w, dp = np.linspace(2.5, 6, 40), np.linspace(1e6, 6e6, 40)
    learned = flowmap.flow("e1", w, dp)
    np.testing.assert_allclose(sheet.flow("e1", w, dp), learned, atol=4e-3 * learned.max())


@pytest.mark.parametrize("name", ["map.xls", "map"])
def test_unknown_format_names_the_known_ones(flowmap: FlowMap, tmp_path: Path, name: str) -> None:
    with pytest.raises(MapFileError) as caught:
        write_map(tmp_path / name, flowmap, {})
    assert ".npz" in caught.value.remedy


@pytest.mark.parametrize("content", [b"", b"{}", b'{"schema": "other", "edges": []}', b"\x00\xff"])
@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_a_file_that_is_no_map_is_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"map{suffix}"
    path.write_bytes(content)
    with pytest.raises(MapFileError, match="not a flow map"):
        read_map(path)


def test_arrays_that_do_not_fit_are_refused(flowmap: FlowMap, tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    write_map(path, flowmap, {})
    content = json.loads(path.read_text())
    content["edges"][1]["u_v"].pop()
    path.write_text(json.dumps(content))
    with pytest.raises(MapFileError, match="'e1' has arrays that do not fit"):
        read_map(path)
