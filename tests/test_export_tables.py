"""Maps for calibration tools and MATLAB: read back, they are the published map."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.io import loadmat

from firmware_bridge.lookup import STATUS
from rtid.errors import RtidError
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.estimator.published import publish
from rtid.maps.files import write_map
from rtid.maps.gridded import ERROR_SHARE, Gridded, gridded
from rtid.model import Grid
from tests.flow_maps import machine, orifice, solved

PROVENANCE = {"trace": "run.blf", "digest": "abc", "beta_pa": [7.1e8, 6.9e8]}
LPM, MPA = 6e4, 1e-6


@pytest.fixture(scope="module")
def flowmap() -> FlowMap:
    model = machine(edges=2)
    return publish(solved(model, orifice, np.random.default_rng(0), rows=80))


@pytest.fixture(scope="module")
def grids(flowmap: FlowMap) -> tuple[Gridded, ...]:
    return gridded(flowmap)


def test_straight_lines_between_the_nodes_are_the_map(
    flowmap: FlowMap, grids: tuple[Gridded, ...]
) -> None:
    """To 0.2 % of the largest flow, at random points, near no pressure drop too."""
    rng = np.random.default_rng(1)
    for edge, g in zip(flowmap.edges, grids, strict=True):
        assert np.all(np.diff(g.u_v) > 0) and np.all(np.diff(g.dp_pa) > 0)
        ends = edge.grid.u_v[[0, -1]], edge.grid.dp_pa[[0, -1]]
        assert (g.u_v[[0, -1]] == ends[0]).all() and (g.dp_pa[[0, -1]] == ends[1]).all()
        assert 0.0 in g.dp_pa, "where the flow turns its sign"
        u = rng.uniform(g.u_v[0], g.u_v[-1], 4000)
        dp = np.concatenate([rng.uniform(g.dp_pa[0], g.dp_pa[-1], 3000), rng.uniform(0, 1e5, 1000)])
        lines = RegularGridInterpolator((g.u_v, g.dp_pa), g.flow_m3s)(np.column_stack([u, dp]))
        largest = np.abs(g.flow_m3s).max()
        assert np.abs(lines - edge.flow(u, dp)).max() < 1.1 * ERROR_SHARE * largest


def test_an_independent_reader_takes_the_dcm_file(
    flowmap: FlowMap, grids: tuple[Gridded, ...], tmp_path: Path
) -> None:
    reader = pytest.importorskip("dcmReader.dcm_reader", reason="pip install 'rtid[dev]'")
    write_map(tmp_path / "maps.dcm", flowmap, PROVENANCE)
    read = reader.DcmReader()
    read.read(str(tmp_path / "maps.dcm"))
    assert '* digest: "abc"' in (tmp_path / "maps.dcm").read_text()
    values = {p.name: p for p in read.get_parameters()}
    assert values["beta_0"].value == 710 and values["beta_0"].unit == "MPa"
    maps = {m.name: m for m in read.get_characteristic_maps()}
    assert set(maps) == {f"{g.name}_{x}" for g in grids for x in ("flow", "flow_sd", "flow_status")}
    for g in grids:
        found = maps[f"{g.name}_flow"]
        assert (found.x_dimension, found.y_dimension) == (len(g.dp_pa), len(g.u_v))
        assert (found.unit_x, found.unit_y, found.unit_values) == ("MPa", "V", "L/min")
        at = np.array([[found.values[y][x] for x in sorted(found.values[y])]
                       for y in sorted(found.values)])  # fmt: skip
        np.testing.assert_allclose(at, LPM * g.flow_m3s, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(sorted(found.values), g.u_v, rtol=1e-6)
        codes = maps[f"{g.name}_flow_status"].values
        assert {c for row in codes.values() for c in row.values()} <= set(range(len(STATUS)))


def numbers(parent: ET.Element | None) -> list[float]:
    assert parent is not None
    return [float(v.text or "nan") for v in parent.iter("V")]


def test_an_independent_parser_takes_the_a2l_file(
    flowmap: FlowMap, grids: tuple[Gridded, ...], tmp_path: Path
) -> None:
    """The same names, units and axes as the DCM that is loaded into it."""
    parser = pytest.importorskip("pya2l.parser", reason="pip install 'rtid[dev]'")
    path = tmp_path / "maps.a2l"
    write_map(path, flowmap, PROVENANCE)
    with parser.A2lParser() as reader:
        tree = reader.tree_from_a2l(path.read_bytes())
        assert not reader.warnings
    (module,) = tree.PROJECT.MODULE
    units = {m.Name.Value: m.Unit.Value for m in module.COMPU_METHOD}
    known = {c.Name.Value: c for c in module.CHARACTERISTIC}
    assert set(known) == {
        "beta_0", "beta_1", *(f"{g.name}_flow{s}" for g in grids for s in ("", "_sd", "_status"))
    }  # fmt: skip
    for g in grids:
        flow = known[f"{g.name}_flow"]
        assert flow.Type == "MAP" and units[flow.Conversion.Value] == "L/min"
        x, y = flow.AXIS_DESCR
        assert (x.MaxAxisPoints.Value, y.MaxAxisPoints.Value) == (len(g.dp_pa), len(g.u_v))
        assert [units[a.Conversion.Value] for a in (x, y)] == ["MPa", "V"]
        assert flow.UpperLimit.Value == pytest.approx(LPM * g.flow_m3s.max(), rel=1e-6)
        assert flow.SYMBOL_LINK.SymbolName.Value == f"{g.name}_flow"
    (words,) = module.COMPU_VTAB
    assert words.NumberValuePairs.Value == len(STATUS)


AS_PYTHON = (  # of the lines of a function block
    (r"\(\*.*?\*\)", ""), (r":=", "="), (r"^(\s*)WHILE (.*) DO", r"\1while \2:"),
    (r"^(\s*)IF (.*) THEN", r"\1if \2:"), (r"<>", "!="), (r"END_(WHILE|IF);", ""), (r";", ""),
    (r"\bAND\b", "and"), (r"\bOR\b", "or"), (r"^    ", ""),
)  # fmt: skip


def as_python(block: str) -> tuple[dict[str, list[float]], str]:
    """Constants and statements of a function block, the statements as Python."""
    tables = {
        name: [float(x) for x in values.split(",")]
        for name, values in re.findall(r"(\w+) : ARRAY\S* OF \w+ := \[([^\]]*)\];", block)
    }
    body = block.rpartition("END_VAR")[2].partition("END_FUNCTION_BLOCK")[0]
    body = body.replace("\n        +", " +")
    for pattern, text in AS_PYTHON:
        body = re.sub(pattern, text, body, flags=re.MULTILINE)
    return tables, body


def test_structured_text_and_its_tables_are_the_map(
    flowmap: FlowMap, grids: tuple[Gridded, ...], tmp_path: Path
) -> None:
    write_map(tmp_path / "maps.st", flowmap, PROVENANCE)
    blocks = (tmp_path / "maps.st").read_text().split("FUNCTION_BLOCK RTID_")[1:]
    rng = np.random.default_rng(2)
    for edge, g, block in zip(flowmap.edges, grids, blocks, strict=True):
        table = np.loadtxt(tmp_path / f"maps_{g.name}.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(table[:, 1:], g.flow_m3s, rtol=1e-8)
        np.testing.assert_allclose(table[:, 0], g.u_v)
        tables, body = as_python(block)
        largest = np.abs(g.flow_m3s).max()
        for u, dp in zip(rng.uniform(1.5, 8, 100), rng.uniform(-0.4e6, 7e6, 100), strict=True):
            space: dict[str, Any] = {**tables, "u": u, "dp": dp}
            space["LIMIT"] = lambda *three: sorted(three)[1]
            exec(body, {}, space)
            assert abs(space["q"] - edge.flow(u, dp)) < 1.1 * ERROR_SHARE * largest
            assert STATUS[int(space["stands_on"])] in set(edge.status.ravel()) | {"shut"}


def test_an_independent_parser_takes_structured_text(tmp_path: Path) -> None:
    """A small map: the parser takes a hundredth of a second per number."""
    blark = pytest.importorskip("blark.parse", reason="pip install 'rtid[dev]'")
    grid = Grid(np.array([1.0, 4.0]), np.array([0.0, 1e6]))
    theta = np.array([[[2e-4, 1e-4, 1e-4, 0, 0, 5e-5]]])
    edge = EdgeMap("p-a", grid, 1.0, theta, np.zeros((1, 1, 6, 6)), np.full((1, 1), VALID), {})
    flowmap = FlowMap((edge,))
    write_map(tmp_path / "small.st", flowmap, {"trace": "a *) b"}, gridded(flowmap, 0.9))
    (block,) = blark.parse_source_code((tmp_path / "small.st").read_text()).transform().items
    assert block.name == "RTID_p_a"
    assert [type(part).__name__ for part in block.declarations] == [
        "InputDeclarations", "OutputDeclarations", "VariableDeclarations", "VariableDeclarations",
    ]  # fmt: skip


PROBE = """
model Probe
  Real u = 0.5 + 8 * time;
  Real dp = 3e6 * sin(9 * time) + 3e6;
  Real q;
  maps.Edge_{1} edge;
  Real x(start = 0, fixed = true);
equation
  q = maps.flow_{0}(u, dp);
  edge.u = u;
  edge.dp = dp;
  der(x) = 1;
end Probe;
"""


def test_a_modelica_compiler_takes_the_package_and_its_flows_are_the_map(
    flowmap: FlowMap, grids: tuple[Gridded, ...], tmp_path: Path
) -> None:
    rumoca = pytest.importorskip("rumoca", reason="pip install 'rtid[dev]'")
    path = tmp_path / "maps.mo"
    write_map(path, flowmap, PROVENANCE | {"said": 'a "b" \\'})
    source = path.read_text() + PROBE.format(*(g.name for g in grids))
    got = rumoca.Session().loads(source, model="Probe").simulate(t=1.0, dt=0.02)
    u, dp = (np.asarray(got[name]) for name in ("u", "dp"))
    for edge, name in zip(flowmap.edges, ("q", "edge.q"), strict=True):
        top = edge.grid.u_v[-1], edge.grid.dp_pa[-1]
        flow = edge.flow(np.clip(u, edge.grid.u_v[0], top[0]), np.clip(dp, None, top[1]))
        largest = np.abs(flow).max()
        assert (flow > 0.1 * largest).sum() > 20
        assert np.abs(np.asarray(got[name]) - flow).max() < 1.1 * ERROR_SHARE * largest


def test_maps_whose_names_a_format_cannot_tell_apart_are_refused(
    flowmap: FlowMap, tmp_path: Path
) -> None:
    twins = FlowMap(
        tuple(replace(e, name=n) for e, n in zip(flowmap.edges, ("p-a", "p a"), strict=True))
    )
    for suffix in (".a2l", ".mo", ".st"):
        with pytest.raises(RtidError, match="called p_a"):
            write_map(tmp_path / f"maps{suffix}", twins, PROVENANCE)
    assert not list(tmp_path.iterdir())


def test_cdfx_holds_the_same_and_its_elements_are_in_order(
    flowmap: FlowMap, grids: tuple[Gridded, ...], tmp_path: Path
) -> None:
    write_map(tmp_path / "maps.cdfx", flowmap, PROVENANCE)
    root = ET.parse(tmp_path / "maps.cdfx").getroot()
    assert [e.tag for e in root] == ["SHORT-NAME", "INTRODUCTION", "CATEGORY", "SW-SYSTEMS"]
    assert root.findtext("CATEGORY") == "CDF20"
    path = "SW-SYSTEMS/SW-SYSTEM/SW-INSTANCE-SPEC/SW-INSTANCE-TREE/SW-INSTANCE"
    found = {str(e.findtext("SHORT-NAME")): e for e in root.findall(path)}
    assert numbers(found["beta_1"].find("SW-VALUE-CONT/SW-VALUES-PHYS")) == [690.0]
    order = ["SHORT-NAME", "LONG-NAME", "CATEGORY", "SW-VALUE-CONT", "SW-AXIS-CONTS"]
    for g in grids:
        own = found[f"{g.name}_flow"]
        assert [e.tag for e in own] == order and own.findtext("CATEGORY") == "MAP"
        rows = own.findall("SW-VALUE-CONT/SW-VALUES-PHYS/VG")
        values = np.array([numbers(row) for row in rows])
        np.testing.assert_allclose(values, LPM * g.flow_m3s, rtol=1e-6, atol=1e-9)
        x, y = own.findall("SW-AXIS-CONTS/SW-AXIS-CONT/SW-VALUES-PHYS")
        np.testing.assert_allclose(numbers(x), MPA * g.dp_pa, rtol=1e-6)
        np.testing.assert_allclose(numbers(y), g.u_v, rtol=1e-6)


def test_a_mat_file_round_trips_to_the_last_digit(
    flowmap: FlowMap, grids: tuple[Gridded, ...], tmp_path: Path
) -> None:
    write_map(tmp_path / "maps.mat", flowmap, PROVENANCE)
    maps = loadmat(tmp_path / "maps.mat", squeeze_me=True, struct_as_record=False)["maps"]
    assert '"digest": "abc"' in str(maps.provenance)
    for g in grids:
        own = getattr(maps, g.name)
        np.testing.assert_array_equal(own.flow_m3s, g.flow_m3s)
        np.testing.assert_array_equal(own.sd_m3s, g.sd_m3s)
        np.testing.assert_array_equal(own.u_v, g.u_v)
        np.testing.assert_array_equal(own.dp_pa, g.dp_pa)
        np.testing.assert_array_equal(own.status, g.code)


def test_the_matlab_script_holds_tables_of_the_right_shape(
    flowmap: FlowMap, grids: tuple[Gridded, ...], tmp_path: Path
) -> None:
    write_map(tmp_path / "maps.m", flowmap, PROVENANCE)
    text = (tmp_path / "maps.m").read_text()
    joined = re.sub(r" \.\.\.\n", " ", text)  # what MATLAB makes of continued lines
    for g in grids:
        assert f"{g.name}_flow = Simulink.LookupTable;" in joined
        tables = {f"{g.name}_flow.Table.Value": g.flow_m3s, f"{g.name}_flow_sd": g.sd_m3s}
        for name, expected in tables.items():
            (body,) = re.findall(rf"^{re.escape(name)} = \[(.*?)\];", joined, re.M | re.S)
            rows = [r.split() for r in body.split(";") if r.strip()]
            np.testing.assert_allclose(np.array(rows, float), expected, rtol=1e-8, atol=1e-15)
        for k, axis in ((1, g.u_v), (2, g.dp_pa)):
            (body,) = re.findall(rf"^{g.name}_flow.Breakpoints\({k}\).Value = \[(.*?)\];", joined,
                                 re.M | re.S)  # fmt: skip
            np.testing.assert_allclose(np.array(body.split(), float), axis, rtol=1e-8)


@pytest.mark.parametrize(
    ("suffix", "words"),
    [
        (".csv", ("u_V", "dp_Pa", "Q_m3/s", "sd_m3/s")),
        (".json", ('"u_v": "V"', '"dp_pa": "Pa"', '"theta_m3s": "m3/s"')),
        (".m", ("command in V", "pressure drop in Pa", "flow in m3/s", "deviation, m3/s")),
        (".dcm", ('EINHEIT_X "MPa"', 'EINHEIT_Y "V"', 'EINHEIT_W "L/min"')),
        (".cdfx", ("<UNIT-DISPLAY-NAME>MPa<", "<UNIT-DISPLAY-NAME>L/min<")),
    ],
)
def test_every_file_says_its_units(
    flowmap: FlowMap, tmp_path: Path, suffix: str, words: tuple[str, ...]
) -> None:
    path = tmp_path / f"maps{suffix}"
    write_map(path, flowmap, PROVENANCE)
    text = path.read_text()
    assert [word for word in words if word not in text] == []
