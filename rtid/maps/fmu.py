"""The learned machine as a functional mock-up unit (FMU), for co-simulation by FMI 2.0 or 3.0.

With a pressure equation in every chamber it is the free run of `rtid.compare.simulation`: commands
(held over a step), supply, tank, position and their rates in, the chambers' pressures out.  As the
map alone the pressures are inputs.  Both tell each edge's flow with its 95 % interval and what it
stands on.  Inside are the C sources (fmu_c/, firmware_bridge/c/rtid_map.c), the numbers as
rtid_model.h, and a binary for the platform at hand where there is a C compiler.
"""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from firmware_bridge.c_tables import HEADER
from firmware_bridge.lookup import MOST_COUNT, Table
from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.state import build, nominal_weights
from rtid.estimator.windows import OVERLAP
from rtid.kernels.layout import FLOW, HINGE, INVERSE, ROOT
from rtid.kernels.map_point import foot_width
from rtid.maps.c_header import float_map
from rtid.maps.fmu_description import FmuVariable, described
from rtid.maps.lookup import ERROR_PERCENT, drops, sample
from rtid.model import MODE, Edge, Machine
from rtid.plain import FloatArray
from rtid.trace.state_files import replacing

SUFFIX, IDENTIFIER = ".fmu", "rtid_machine"
VERSIONS = (2, 3)
SOURCES = Path(__file__).with_name("fmu_c")
OURS = ("rtid_machine.h", "rtid_machine.c", "rtid_fmi.c")
MAPS = ("rtid_map.h", "rtid_map.c", "rtid_map_search.h", "rtid_version.h")
COMPILED = ("rtid_fmi.c", "rtid_machine.c", "rtid_map.c")
SYSTEMS = {  # of platform.system(): by FMI 2.0, by FMI 3.0, suffix
    "Linux": ("linux", "linux", ".so"),
    "Darwin": ("darwin", "darwin", ".dylib"),
}
MOST_MINUTES = 2


class NoFmuError(RtidError):
    """A machine that cannot become an FMU; the text says why."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """What makes pressures of flows: compliance (chambers,) 1/Pa, coefficients (terms,), lag."""

    compliance: FloatArray
    terms: FloatArray
    lag_s: float


def write_fmu(
    path: Path,
    model: Machine,
    flowmap: FlowMap,
    dynamics: Dynamics | None,
    provenance: Mapping[str, Any],
    version: int = 2,
) -> bool:
    """Write the FMU, whole or not at all; whether there is a binary in it.

    dynamics: None for the map alone.  Raises NoFmuError, NoTableError, OSError.
    """
    check_version(version)
    _check(model, dynamics)
    header, variables = _model(model, flowmap, dynamics)
    token = hashlib.sha256(header.encode()).hexdigest()
    header = header.replace("@TOKEN@", token)
    about = "the learned machine" if dynamics else "learned flow maps"
    xml = described(version, IDENTIFIER, token, variables, COMPILED, f"{about}, {provenance}")
    with TemporaryDirectory(prefix="rtid-") as folder:
        root = Path(folder, "fmu")
        _sources(root / "sources", header)
        for name, text in xml.items():
            (root / name).write_text(text, "utf-8")
        _place(root / "resources").joinpath("provenance.json").write_text(
            json.dumps(dict(provenance)), "utf-8"
        )
        has_binary = _compiled(root, version)
        with replacing(path) as part:
            _pack(root, part)
    return has_binary


def check_version(version: int) -> None:
    """NoFmuError for a version of FMI that is not written."""
    if version not in VERSIONS:
        raise NoFmuError(f"there is no FMI {version} here", "--fmi 2 or --fmi 3")


def _check(model: Machine, dynamics: Dynamics | None) -> None:
    if dynamics is None:
        return
    without = [c.name for c in model.chambers if not c.pressure]
    if without:
        raise NoFmuError(
            f"chamber {', '.join(without)} has no pressure equation", "--map exports the map alone"
        )
    strange = [s.name for s in model.signals if s.kind == "volume"]
    if strange:
        raise NoFmuError(
            f"{', '.join(strange)} follows the record and has no law of pressures alone",
            "--map exports the map alone; or drop the effect",
        )
    known = (dynamics.compliance > 0) & np.isfinite(dynamics.compliance)
    if not known.all() or not np.isfinite(dynamics.terms).all():
        raise NoFmuError("no bulk modulus is known of it", "--map exports the map alone")


def _model(
    model: Machine, flowmap: FlowMap, dynamics: Dynamics | None
) -> tuple[str, list[FmuVariable]]:
    """rtid_model.h, and the variables as a model description lists them."""
    engine = build(model.with_taylor_maps, nominal_weights(model)).engine
    e = engine.view(np.recarray)[0]
    chambers = len(model.chambers) if dynamics else 0
    variables = list(_variables(model, dynamics, _used(model, dynamics)))
    lines = [
        "/* A machine learned by rtid: do not edit. */",
        "#ifndef RTID_MODEL_H",
        "#define RTID_MODEL_H",
        '#include "rtid_map.h"',
        '#define TOKEN "@TOKEN@"',
        f"enum {{ N_SIGNALS = {int(e['n_signals'])}, X_COLUMN = {e['x_column']} }};",
        f"enum {{ MODE_COLUMN = {e['mode_column']} }};",
        f"#define N_CHAMBERS {chambers}",
        f"#define N_TERMS {len(model.terms) if dynamics else 0}",
        f"#define N_EDGES {len(model.edges)}",
        f"#define OVERLAP {OVERLAP!r}",
        f"enum {{ SHAPE_FLOW = {FLOW}, SHAPE_ROOT = {ROOT}, SHAPE_HINGE = {HINGE}, "
        f"SHAPE_INVERSE = {INVERSE} }};",
        *_of_edges(model, e, flowmap),
        *(_of_chambers(model, e, dynamics) if dynamics else ()),
        *_doubles("START", _starts(variables, 1 + 2 * int(e["n_signals"]) + chambers + 1)),
    ]
    for edge in model.edges:
        name = f"sd_{edge.name}".replace("-", "_")
        lines += float_map(name, deviations(edge, flowmap))
    tables = ", ".join(f"&sd_{edge.name}".replace("-", "_") for edge in model.edges)
    lines += [f"static const rtid_map *const TABLES[] = {{{tables}}};", "#endif"]
    return "\n".join(lines) + "\n", variables


def _of_edges(model: Machine, e: np.record, flowmap: FlowMap) -> list[str]:
    """The grids and the map of every edge, and between which signals it lies."""
    edges, borders = len(model.edges), [(edge.grid.u_v, edge.grid.dp_pa) for edge in model.edges]
    return [
        *_ints("N_U", e["n_u"][:edges]), *_ints("N_DP", e["n_dp"][:edges]),
        *_ints("FIRST_CELL", e["first_cell"][:edges]),
        *_ints("FIRST_U", np.cumsum([0, *(len(u) for u, _ in borders)])),
        *_ints("FIRST_DP", np.cumsum([0, *(len(p) for _, p in borders)])),
        *_doubles("U_BORDER", np.concatenate([u for u, _ in borders])),
        *_doubles("DP_BORDER", np.concatenate([p for _, p in borders])),
        *_doubles("THETA", flowmap.theta_cells()),
        *_doubles("SAFE_V", e["safe_v"][:edges]),
        *_doubles("FOOT_V", np.array([foot_width.py_func(e, i, OVERLAP) for i in range(edges)])),
        *_doubles("DIRECTION", e["direction"][:edges]),
        *_ints("COMMAND", e["command"][:edges]),
        *_ints("SOURCE", e["source"][:edges]), *_ints("SINK", e["sink"][:edges]),
        f"static const long long MODES[] = {{{', '.join(f'{m}LL' for m in e['modes'][:edges])}}};",
    ]  # fmt: skip


def _of_chambers(model: Machine, e: np.record, dynamics: Dynamics) -> list[str]:
    """What the pressures come from: the chambers, and the terms beside the maps (C has no 0)."""
    n, edges, chambers = int(e["n_signals"]), len(model.edges), len(model.chambers)
    terms = max(len(model.terms), 1)
    return [
        *_ints("P_COLUMN", e["p_column"][:chambers]),
        *_doubles("AREA_M2", e["area_m2"][:chambers]),
        *_doubles("V0_M3", e["v0_m3"][:chambers]),
        *_doubles("GROWTH_M2", e["growth_m2"][:chambers]),
        *_doubles("P_LOW", e["minimum"][e["p_column"][:chambers]]),
        *_doubles("P_HIGH", e["maximum"][e["p_column"][:chambers]]),
        *_doubles("SIGN", e["sign"][:edges, :chambers]),
        *_ints("TERM_SHAPE", e["term_shape"][:terms]),
        *_ints("TERM_VOLUME", e["term_volume"][:terms]),
        *_doubles("TERM_THETA", np.append(dynamics.terms, 0.0)),
        *_doubles("TERM_SCALE", e["term_scale"][:terms]),
        *_doubles("TERM_CONSTANT", e["term_constant"][:terms]),
        *_doubles("TERM_WEIGHT", e["term_weight"][:terms, :n]),
        *_doubles("TERM_SIGN", e["term_sign"][:terms, :chambers]),
    ]


def _starts(variables: Sequence[FmuVariable], n: int) -> FloatArray:
    """The values (n,) with which the variables begin, by their references, in their SI units."""
    start = np.zeros(n)
    for variable in variables:
        if variable.reference < n and variable.start is not None:
            start[variable.reference] = variable.start
    return start


def deviations(edge: Edge, flowmap: FlowMap) -> Table:
    """The table of an edge's standard deviation, m3/s, at the nodes of its look-up table."""
    published = flowmap[edge.shares or edge.name]
    flow = sample(edge, published, ERROR_PERCENT).table
    w, s = np.clip(flow.w_v.astype(float), *published.grid.u_v[[0, -1]]), flow.s.astype(float)
    sd = np.nan_to_num(published.sd(w[:, None], drops(published.grid.dp_pa, s)[None, :]))
    scale = max(float(sd.max()) / MOST_COUNT, 1e-15)
    counts = np.round(sd / scale).astype(np.int16)
    return replace(flow, counts=counts, scale=float(np.float32(scale)))


def _used(model: Machine, dynamics: Dynamics | None) -> set[str]:
    """Signals that something depends on."""
    used = {name for edge in model.edges for name in (edge.source, edge.sink, edge.command)}
    used |= {signal.name for signal in model.signals if signal.kind == MODE}
    if dynamics:
        used |= {name for term in model.terms for name, _ in term.weights} | {model.position}
    return used - {""}


def _variables(model: Machine, dynamics: Dynamics | None, used: set[str]) -> Iterator[FmuVariable]:
    """All variables, with their places in `Machine.real` of fmu_c/rtid_machine.h."""
    n = len(model.signals)
    states = {c.pressure: c for c in model.chambers} if dynamics else {}
    for k, signal in enumerate(model.signals):
        if signal.name not in used:
            continue
        unit, at = signal.unit, 1 + k
        if signal.name in states:
            about = f"pressure of chamber {states[signal.name].name}; its start is the run's"
            yield FmuVariable(signal.name, at, "state", unit, about, 1e5)
            continue
        kind = "command" if signal.is_held else "input"
        yield FmuVariable(signal.name, at, kind, unit, f"{signal.kind}", _start(signal.minimum))
        if dynamics and not signal.is_held:
            about = f"rate of {signal.name} over the step"
            yield FmuVariable(f"{signal.name}_rate", at + n, "command", f"{unit}/s", about, 0.0)
    at = 1 + 2 * n
    if dynamics:
        for chamber, compliance in zip(model.chambers, dynamics.compliance, strict=True):
            about = f"effective bulk modulus of chamber {chamber.name}"
            yield FmuVariable(f"beta_{chamber.name}", at, "parameter", "Pa", about, 1 / compliance)
            at += 1
        yield FmuVariable(
            "lag", at, "parameter", "s", "first-order lag of the spools", dynamics.lag_s
        )
    at += 1
    for word, about in (("", "flow"), ("_low", "95 % interval"), ("_high", "95 % interval")):
        for edge in model.edges:
            text = f"{about} of edge {edge.name}"
            unit = next((c.unit for c in model.chambers if edge.sign(c)), "m3/s")
            yield FmuVariable(f"Q_{edge.name}{word}", at, "output", unit, text)
            at += 1
    for edge in model.edges:
        text = f"what Q_{edge.name} stands on: 0 data, 1 shut, 2 few data, 3 the orifice law, "
        yield FmuVariable(
            f"status_{edge.name}", at, "status", "", text + "4 declared, 5 off its grid"
        )
        at += 1
    text = "the last step: 1 inside all grids, 2 a pressure drop beyond its grid, 4 a command"
    yield FmuVariable("status", at, "status", "", text)


def _start(minimum: float) -> float:
    return float(max(minimum, 0.0)) if np.isfinite(minimum) else 0.0


def _ints(name: str, values: Iterable[Any]) -> Iterator[str]:
    yield f"static const int {name}[] = {{{', '.join(str(int(v)) for v in values)}}};"


def _doubles(name: str, values: FloatArray) -> Iterator[str]:
    """An array of one or two dimensions, to the last bit; infinities as the largest number."""
    values = np.clip(np.asarray(values, float), -1e300, 1e300)
    columns = f"[{values.shape[1]}]" if values.ndim == 2 else ""
    yield f"static const double {name}[]{columns} = {{"
    for row in values.reshape(len(values), -1):
        text = ", ".join(repr(float(v)) for v in row)
        yield f"    {{{text}}}," if columns else f"    {text},"
    yield "};"


def _place(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def _sources(folder: Path, header: str) -> None:
    _place(folder)
    for name in OURS:
        shutil.copyfile(SOURCES / name, folder / name)
    for name in MAPS:
        shutil.copyfile(HEADER.with_name(name), folder / name)
    (folder / "rtid_model.h").write_text(header, "utf-8")


def _compiled(root: Path, version: int) -> bool:
    """Build a binary for this platform; False where there is no C compiler, or none that can."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None or platform.system() not in SYSTEMS:
        return False
    two, three, suffix = SYSTEMS[platform.system()]
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    tuple_ = f"{two}64" if version == VERSIONS[0] else f"{machine}-{three}"
    out = _place(root / "binaries" / tuple_) / f"{IDENTIFIER}{suffix}"
    options = ["-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-w"]
    sources = [str(root / "sources" / name) for name in COMPILED]
    done = subprocess.run(
        [compiler, *options, f"-DFMI_VERSION={version}", "-o", str(out), *sources, "-lm"],
        capture_output=True, text=True, check=False, timeout=60 * MOST_MINUTES,
    )  # fmt: skip
    if done.returncode:
        raise NoFmuError(f"{compiler} cannot compile it: {done.stderr.strip()[-300:]}")
    return True


def _pack(root: Path, path: Path) -> None:
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        for file in sorted(root.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(root).as_posix())
