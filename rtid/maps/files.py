"""Learned flow maps as files: a long CSV table, or JSON and npz that hold everything.

The CSV has one line per node and centre of the grids; JSON and npz come back with `read_map`.
Tables for calibration tools and MATLAB are in `rtid.maps.calibration` and `rtid.maps.matlab`.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import entry_points
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

import rtid
from firmware_bridge.sources.unpacked import Budget
from rtid.errors import RtidError, door
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.estimator.solution import Solution
from rtid.maps.a2l import write_a2l
from rtid.maps.calibration import write_cdfx, write_dcm
from rtid.maps.gridded import Tables, gridded
from rtid.maps.matlab import write_m, write_mat
from rtid.maps.modelica import write_mo
from rtid.maps.pedals import ACCEL, BRAKE, write_pedals
from rtid.maps.plc import write_st
from rtid.model import NONE, Grid, Machine
from rtid.plain import FloatArray, plain
from rtid.trace.state_files import read_bytes, replacing

SCHEMA = "rtid-flowmap/1"
PLUGINS = "rtid.export"  # entry points of other packages: suffix = function, as in WRITERS
FLOW_UNIT, COMMAND_UNIT, DROP_UNIT = "m3/s", "V", "Pa"  # where the provenance says no others
MAP_FILES = (".json", ".npz")  # what comes back with `read_map`
BASIS = "Taylor: 1, xi, eta, xi^2, eta^2, xi eta; xi and eta run from -1 to 1 over each block"

Writer = Callable[[Path, FlowMap, Mapping[str, Any]], None]


class MapFileError(RtidError):
    """A map file that cannot be written or read; the text names the file and the reason."""


@door
def write_map(
    path: str | Path, flowmap: FlowMap, provenance: Mapping[str, Any], tables: Tables | None = None
) -> None:
    """Write the map in the format that the file's suffix names; whole or not at all.

    tables: what a format of TABLE_WRITERS holds of it; None: the smallest that are close enough.
    """
    path = Path(path)
    if path.name in (ACCEL, BRAKE):
        write_pedals(path, flowmap, provenance)
        return
    write_tables = TABLE_WRITERS.get(path.suffix.lower())
    write = None if write_tables else writer_of(path.suffix.lower())
    if write is None and write_tables is None:
        raise MapFileError(f"{path}: unknown format", f"end the name in {', '.join(formats())}")
    unit = provenance.get("flow_unit", FLOW_UNIT)
    if unit != FLOW_UNIT and write_tables is not None:
        raise MapFileError(
            f"{path}: this format says L/min or m3/s, and the map is in {unit}",
            "write .csv, .json, .npz or .fmu",
        )
    with replacing(path) as part:
        if write_tables is not None:
            write_tables(part, tables or gridded(flowmap), provenance)
        elif write is not None:
            write(part, flowmap, provenance)


def formats() -> tuple[str, ...]:
    """Suffixes that can be written: the built-in ones, and those of plug-ins."""
    return tuple(dict.fromkeys([*WRITERS, *TABLE_WRITERS, *entry_points(group=PLUGINS).names]))


def writer_of(suffix: str) -> Writer | None:
    """What writes maps under a suffix; a plug-in is loaded.  Raises MapFileError where it fails."""
    if suffix in WRITERS:
        return WRITERS[suffix]
    for plugin in entry_points(group=PLUGINS, name=suffix):
        try:
            writer: Writer = plugin.load()
        except Exception as error:
            raise MapFileError(
                f"the plug-in {plugin.value} for {suffix} does not load: {error}",
                "correct or uninstall its package",
            ) from error
        return writer
    return None


@door
def read_map(path: str | Path) -> tuple[FlowMap, dict[str, Any]]:
    """A map written as JSON or npz, with its provenance.  Raises MapFileError, OSError."""
    path = Path(path)
    read = {".json": _read_json, ".npz": _read_npz}.get(path.suffix.lower())
    if read is None:
        raise MapFileError(f"{path}: no map to read back", "give the .json or .npz file")
    try:
        header, parts = read(path)
        if header["schema"] != SCHEMA:
            raise ValueError(f"schema {header['schema']!r}")
        return FlowMap(tuple(_edge(part) for part in parts)), header["provenance"]
    except (KeyError, TypeError, ValueError, EOFError, BadZipFile) as error:
        raise MapFileError(f"{path}: not a flow map of {SCHEMA} ({error})") from error


def provenance(
    solution: Solution,
    project: str,
    digest: str,
    source: str,
    effects: Sequence[Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Where a map comes from, in JSON types: what was learned from, and how well it fits.

    effects: those beside which it was fitted, whose flow is not in the map; None: not known.
    """
    known: dict[str, Any] = {} if effects is None else {"effects": list(effects)}
    return {
        **known,
        **unusual_units(solution.model),
        "program": f"rtid {rtid.__version__}",
        "project": project,
        "digest": digest,
        "source": source,
        "rows": solution.counters.get("rows", 0),
        "rho": solution.rho,
        "beta_pa": plain(solution.beta_pa),
        "beta_sd_pa": plain(solution.beta_sd_pa),
    }


def unusual_units(model: Machine) -> dict[str, str]:
    """Units of commands, second arguments and flows that are not V, Pa and m3/s: for a provenance.

    over_unit: of a plant without pressures, "1" where its maps are of the command alone.
    """
    axes = [model.axes(edge) for edge in model.maps]
    units = {
        "command_unit": {a.command for a in axes},
        "over_unit": {a.second for a in axes if a.over != NONE} or {"1"},
        "flow_unit": {chamber.unit for chamber in model.chambers},
    }
    usual = {"command_unit": COMMAND_UNIT, "flow_unit": FLOW_UNIT}
    usual |= {"over_unit": DROP_UNIT} if model.has_pressures else {}
    known = {key: "+".join(sorted(names)) for key, names in units.items()}
    return {key: names for key, names in known.items() if names != usual.get(key)}


def columns(provenance: Mapping[str, Any]) -> tuple[str, ...]:
    """Heads of the long table, with the units that a provenance says."""
    command = provenance.get("command_unit", COMMAND_UNIT)
    flow, over = provenance.get("flow_unit", FLOW_UNIT), provenance.get("over_unit")
    second = f"dp_{DROP_UNIT}" if over is None else "over" if over == "1" else f"over_{over}"
    return "edge", f"u_{command}", second, f"Q_{flow}", f"sd_{flow}", "status"


def table_rows(flowmap: FlowMap) -> Iterator[tuple[str, float, float, float, float, str]]:
    """Of `columns`: edge, u, dp, q and sd in SI, status; at all nodes and centres of the grids."""
    for edge in flowmap.edges:
        w, dp = np.meshgrid(_halves(edge.grid.u_v), _halves(edge.grid.dp_pa), indexing="ij")
        values = (w, dp, edge.flow(w, dp), edge.sd(w, dp), edge.status_at(w, dp))
        for row in zip(*(v.ravel().tolist() for v in values), strict=True):
            yield edge.name, *row


def _halves(border: FloatArray) -> FloatArray:
    return np.interp(np.arange(2 * len(border) - 1) / 2, np.arange(len(border)), border)


def _write_csv(path: Path, flowmap: FlowMap, provenance: Mapping[str, Any]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(f"# {SCHEMA} {json.dumps(provenance, sort_keys=True)}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns(provenance))
        for edge, u, dp, q, sd, status in table_rows(flowmap):
            writer.writerow([edge, f"{u:.9g}", f"{dp:.9g}", f"{q:.9g}", f"{sd:.3g}", status])


def as_dict(flowmap: FlowMap, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The whole map in plain JSON types; `valid` marks the cells that stand on their own data."""
    edges = []
    for edge in flowmap.edges:
        arrays = {name: array.tolist() for name, array in _arrays(edge).items()}
        edges.append(_words(edge) | arrays | {"valid": (edge.status == VALID).tolist()})
    return _header(provenance) | {"edges": edges}


def _header(provenance: Mapping[str, Any]) -> dict[str, Any]:
    told = {"units": _units(provenance), "basis": BASIS, "provenance": dict(provenance)}
    return {"schema": SCHEMA} | told


def _units(provenance: Mapping[str, Any]) -> dict[str, str]:
    """By array, whose names are those of a hydraulic machine on every plant."""
    flow = provenance.get("flow_unit", FLOW_UNIT)
    return {
        "u_v": provenance.get("command_unit", COMMAND_UNIT),
        "dp_pa": provenance.get("over_unit", DROP_UNIT),
        "theta_m3s": flow,
        "cov_m6s2": "m6/s2" if flow == FLOW_UNIT else f"({flow})^2",
    }


def _arrays(edge: EdgeMap) -> dict[str, np.ndarray]:
    return {
        "u_v": edge.grid.u_v,
        "dp_pa": edge.grid.dp_pa,
        "theta_m3s": edge.theta,
        "cov_m6s2": edge.cov,
        "status": edge.status,
    }


def _words(edge: EdgeMap) -> dict[str, Any]:
    """What is no array; a safe band of -inf (none declared) is null, as JSON knows no infinity."""
    safe = edge.safe_band_v if np.isfinite(edge.safe_band_v) else None
    reason = [[i, j, text] for (i, j), text in sorted(edge.reason.items())]
    return {"name": edge.name, "safe_band_v": safe, "reason": reason}


def _edge(part: Mapping[str, Any]) -> EdgeMap:
    grid = Grid(np.asarray(part["u_v"], float), np.asarray(part["dp_pa"], float))
    theta, cov = np.asarray(part["theta_m3s"], float), np.asarray(part["cov_m6s2"], float)
    status = np.asarray(part["status"], np.str_)
    shapes = (*grid.shape, 6), (*grid.shape, 6, 6), grid.shape
    if (theta.shape, cov.shape, status.shape) != shapes:
        raise ValueError(f"edge {part['name']!r} has arrays that do not fit its grid")
    safe = -np.inf if part["safe_band_v"] is None else float(part["safe_band_v"])
    reason = {(int(i), int(j)): str(text) for i, j, text in part["reason"]}
    return EdgeMap(str(part["name"]), grid, safe, theta, cov, status, reason)


def _write_json(path: Path, flowmap: FlowMap, provenance: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(as_dict(flowmap, provenance)), encoding="utf-8")


def _read_json(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    content = json.loads(read_bytes(path))
    return content, content["edges"]


def _write_npz(path: Path, flowmap: FlowMap, provenance: Mapping[str, Any]) -> None:
    """One array per edge and name, as `edge number/name`; all words as JSON in `header`."""
    header = _header(provenance) | {"edges": [_words(edge) for edge in flowmap.edges]}
    arrays: dict[str, Any] = {
        f"{k}/{name}": array
        for k, edge in enumerate(flowmap.edges)
        for name, array in _arrays(edge).items()
    }
    with path.open("wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


def _read_npz(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    with np.load(BytesIO(read_bytes(path)), allow_pickle=False) as file:
        Budget(path).take(sum(entry.file_size for entry in file.zip.infolist()))
        header = json.loads(str(file["header"]))
        names = [name for name in file.files if name != "header"]
        parts = [
            words | {n.partition("/")[2]: file[n] for n in names if n.startswith(f"{k}/")}
            for k, words in enumerate(header["edges"])
        ]
    return header, parts


WRITERS: dict[str, Writer] = {".csv": _write_csv, ".json": _write_json, ".npz": _write_npz}
TABLE_WRITERS: dict[str, Callable[[Path, Tables, Mapping[str, Any]], None]] = {
    ".mat": write_mat, ".m": write_m, ".dcm": write_dcm, ".cdfx": write_cdfx, ".a2l": write_a2l,
    ".mo": write_mo, ".st": write_st,
}  # fmt: skip
