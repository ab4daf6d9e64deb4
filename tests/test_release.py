"""Tables for a controller: of a size, on given axes, and held against what is there now."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.maps.files import write_map
from rtid.maps.flashed import FlashedError, differences, of_edge, read_flashed
from rtid.maps.gridded import ERROR_SHARE, Tables, gridded
from rtid.maps.lookup import NoTableError
from rtid.maps.release import Room, tables_for
from rtid.tell.released import said, sheet
from tests.flow_maps import machine, orifice, solved

LPM = 6e4


@pytest.fixture(scope="module")
def flowmap() -> FlowMap:
    model = machine(edges=2)
    return publish(solved(model, orifice, np.random.default_rng(0), rows=80))


def misses(flowmap: FlowMap, tables: Tables) -> list[float]:
    """Largest distance at random points, of the largest flow, by somebody else's interpolation."""
    rng, worst = np.random.default_rng(1), []
    for edge, g in zip(flowmap.edges, tables, strict=True):
        u = rng.uniform(g.u_v[0], g.u_v[-1], 20_000)
        dp = rng.uniform(g.dp_pa[0], g.dp_pa[-1], 20_000)
        lines = RegularGridInterpolator((g.u_v, g.dp_pa), g.flow_m3s)(np.column_stack([u, dp]))
        worst.append(float(np.abs(lines - edge.flow(u, dp)).max() / np.abs(g.flow_m3s).max()))
    return worst


@pytest.mark.parametrize("share", [1e-3, ERROR_SHARE, 1e-2, 5e-2])
def test_a_table_keeps_what_it_says_and_not_much_better(flowmap: FlowMap, share: float) -> None:
    tables = tables_for(flowmap, Room(share))
    for g, miss in zip(tables, misses(flowmap, tables), strict=True):
        assert g.miss <= share and miss < 1.15 * g.miss + 1e-4
        assert g.miss > 0.4 * share, "it would be smaller"


def test_a_table_has_far_fewer_nodes_than_a_block_has_borders_and_points(flowmap: FlowMap) -> None:
    """The borders of the blocks and all between them are nobody's map."""
    for edge, g in zip(flowmap.edges, gridded(flowmap), strict=True):
        assert g.flow_m3s.size < 0.4 * (8 * edge.grid.shape[0]) * (8 * edge.grid.shape[1])


def test_the_best_that_fits_is_taken(flowmap: FlowMap) -> None:
    alone = FlowMap(flowmap.edges[:1])
    (small,), (large,) = (tables_for(alone, Room(n_bytes=n)) for n in (200, 1000))
    assert small.n_bytes <= 200 < large.n_bytes <= 1000
    assert large.miss < 0.5 * small.miss
    (table,) = tables_for(alone, Room(nodes=(8, 9)))
    assert len(table.u_v) <= 8 and len(table.dp_pa) <= 9
    with pytest.raises(NoTableError, match="no table is so small"):
        tables_for(alone, Room(n_bytes=10))
    with pytest.raises(RtidError, match="each enough"):
        tables_for(alone, Room(share=0.01, nodes=(8, 8)))


@pytest.mark.parametrize("suffix", [".dcm", ".cdfx"])
def test_axes_and_values_come_back_from_a_file(
    flowmap: FlowMap, tmp_path: Path, suffix: str
) -> None:
    path, tables = tmp_path / f"maps{suffix}", gridded(flowmap, 0.02)
    write_map(path, flowmap, {"beta_pa": [7e8]}, tables)
    maps = read_flashed(path)
    assert [m.name for m in maps] == ["e0_flow", "e1_flow"]
    again = tables_for(flowmap, Room(axes=maps))
    for g, old in zip(again, tables, strict=True):
        np.testing.assert_allclose(g.u_v, old.u_v, rtol=1e-6)
        np.testing.assert_allclose(g.dp_pa, old.dp_pa, rtol=1e-6, atol=1.0)
    assert max(d.share for d in differences(flowmap, maps)) < 1e-6


def test_a_table_of_a_spreadsheet_is_held_against_the_map(flowmap: FlowMap, tmp_path: Path) -> None:
    (g, _), path = gridded(flowmap, 0.02), tmp_path / "old.csv"
    flow = g.flow_m3s.copy()
    flow[2, 3] += 0.5 / LPM
    rows = [[u, *row] for u, row in zip(g.u_v, flow, strict=True)]
    head = ["u", *g.dp_pa]
    path.write_text("\n".join(",".join(str(x) for x in row) for row in (head, *rows)))
    first, second = differences(flowmap, read_flashed(path))
    assert first.largest_m3s * LPM == pytest.approx(-0.5, rel=1e-6)
    assert (first.u_v, first.dp_pa) == (g.u_v[2], g.dp_pa[3])
    assert second.edge == "e1", "the only map that there is stands for every edge"


BROKEN = {
    "no.dcm": 'KENNFELD a 2 2\n EINHEIT_X "MPa"\nEND\n',
    "falls.csv": "u,2,1\n1,0,0\n2,0,0\n",
    "word.csv": "u,1,2\n1,a,0\n2,0,0\n",
    "empty.csv": "",
    "no.cdfx": "<a><b></a>",
    "bomb.cdfx": '<!DOCTYPE a [<!ENTITY x "y">]><a>&x;</a>',
    "no.a2l": "",
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_without_such_maps_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(BROKEN[name])
    with pytest.raises(FlashedError, match=name):
        read_flashed(path)


def test_of_several_maps_one_must_be_called_as_the_edge(flowmap: FlowMap, tmp_path: Path) -> None:
    write_map(tmp_path / "m.dcm", flowmap, {}, gridded(flowmap, 0.05))
    maps = read_flashed(tmp_path / "m.dcm")
    assert of_edge(maps, "e1").name == "e1_flow"
    with pytest.raises(FlashedError, match="no map of edge pa among e0_flow, e1_flow"):
        of_edge(maps, "pa")


def test_the_sheet_tells_what_is_signed(flowmap: FlowMap, tmp_path: Path) -> None:
    tables = gridded(flowmap, 0.01)
    write_map(tmp_path / "m.dcm", flowmap, {}, tables)
    changes = differences(flowmap, read_flashed(tmp_path / "m.dcm"))
    page = sheet("<new>.dcm", tables, changes, {"project": "p & q", "digest": "abc"})
    nodes = f"{len(tables[0].u_v)} x {len(tables[0].dp_pa)}"
    for words in ("&lt;new&gt;.dcm", "p &amp; q", "abc", nodes, "released, date", "Against what"):
        assert words in page
    found = {"value": 2e-12, "std": 7.3e-14, "unit": "m3/s/Pa"}
    leak = {
        "effect": "internal_leakage_laminar",
        "where": "a-b",
        "parameters": {"coefficient": found},
    }
    origin = {
        "effects": [leak],
        "beta_pa": [608115697.1, None],
        "beta_sd_pa": [2e5, None],
        "rho": 1.01234,
    }
    page = sheet("new.dcm", tables, changes, origin)
    for words in (
        "608.1 ± 0.39 MPa</dd>",
        "Internal leakage, laminar (a-b): coefficient 0.12 ± 0.0086 L/min/MPa",
        "1.01 times the noise",
    ):
        assert words in page
    assert not re.search(r"[{\[]['\d]|_pa|e-14", page.partition("</style>")[2])
    lines = "\n".join(said(tables, changes))
    assert nodes in lines and f"together {sum(g.n_bytes for g in tables)} bytes" in lines
    assert "e1 against what is there" in lines
