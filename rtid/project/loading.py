"""Read a project file: TOML -> sections -> checks -> `Project`, all errors named at once."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from firmware_bridge import catalog as catalogs
from firmware_bridge.catalog import Catalog, Place
from rtid.effects import Effect
from rtid.errors import door
from rtid.estimator.limits import unfit
from rtid.model import Machine
from rtid.project import added, build, effects, references, schema, trust
from rtid.project.errors import Problem, ProjectError
from rtid.project.project import Project, Sections
from rtid.project.sections import Raw, read_section
from rtid.units import find_unit, nearest, show_flow_as, units_of

MAX_FILE_BYTES = 4 << 20
SINGLE: dict[str, type[schema.Section]] = {
    "project": schema.ProjectSection,
    "source": schema.SourceSection,
    "geometry": schema.GeometrySection,
    "rate": schema.RateSection,
    "edge_defaults": schema.EdgeDefaults,
    "prior": schema.PriorSection,
    "beta": schema.BetaSection,
    "filter": schema.FilterSection,
    "gates": schema.GatesSection,
    "upkeep": schema.UpkeepSection,
    "dynamics": schema.DynamicsSection,
    "estimator": schema.EstimatorSection,
    "record": schema.RecordSection,
    "daemon": schema.DaemonSection,
    "excite": schema.ExciteSection,
    "controller": schema.ControllerSection,
    "publish": schema.PublishSection,
}
NAMED: dict[str, type[schema.Section]] = {
    "messages": schema.MessageSection,
    "signals": schema.SignalSection,
    "chambers": schema.ChamberSection,
    "edges": schema.EdgeSection,
    "maps": schema.MapSection,
    "effects": schema.EffectSection,
}
REQUIRED = ("project", "source", "signals")
OF_PRESSURES, OF_RATE = ("geometry", "chambers", "edges"), ("rate", "maps")  # one or the other


@door
def load(path: str | Path) -> Project:
    """Read and check a project file; `ProjectError` names every problem."""
    path = Path(path)
    raw = _parse(path)
    parts, problems = _read_sections(raw)
    databases, catalog = _open_dbc(raw, path.parent, problems)
    problems += references.check(raw, catalog, path.parent)
    problems += _across(parts)
    user_effects, more = effects.build(parts, raw, catalog, path.parent)
    problems += more
    if problems:
        first = {problem.path: problem for problem in reversed(problems)}  # one per place
        raise ProjectError(path, [p for p in problems if first[p.path] is p])
    project = _assemble(path, Sections(**parts), databases, catalog, user_effects)
    show_flow_as(project.model.chambers[0].unit)
    return project


def _parse(path: Path) -> Raw:
    try:
        if not path.is_file() and path.exists():  # a folder; a FIFO would be waited for
            raise ProjectError(path, [Problem("file", "is no file", "name a project file")])
        if path.stat().st_size > MAX_FILE_BYTES:
            problem = Problem("file", f"larger than {MAX_FILE_BYTES >> 20} MiB", "is it a project?")
            raise ProjectError(path, [problem])
        return tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        problem = Problem("file", "does not exist", "name a project file; `rtid init` writes one")
        raise ProjectError(path, [problem]) from None
    except OSError as error:
        problem = Problem("file", f"cannot be read: {error.strerror}", "name a project file")
        raise ProjectError(path, [problem]) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        problem = Problem("file", f"not valid TOML: {error}", "correct this place first")
        raise ProjectError(path, [problem]) from None


def _read_sections(raw: Raw) -> tuple[dict[str, Any], list[Problem]]:
    known = [*SINGLE, *NAMED, "modes", "added"]
    problems = [
        Problem(name, "unknown section", nearest(name, known)) for name in raw if name not in known
    ]
    problems += [
        Problem(name, "missing", f"add a section [{name}]")
        for name in (*REQUIRED, *(OF_RATE if "rate" in raw else OF_PRESSURES))
        if name not in raw and not (name == "geometry" and references.goes_round(raw))
    ]
    if "rate" in raw:
        problems += [
            Problem(n, "has no place beside [rate]", "drop it: a plant has pressures, or a rate")
            for n in (*OF_PRESSURES, "edge_defaults", "modes")
            if n in raw
        ]
    parts: dict[str, Any] = {"messages": {}}
    for name, kind in SINGLE.items():
        if name in raw:
            parts[name], result = read_section(kind, raw[name], name)
            problems += result
    for name, kind in NAMED.items():
        if name in raw:
            parts[name], result = _read_named(kind, raw[name], name)
            problems += result
    parts["added"], result = added.read(raw.get("added", []))
    problems += result
    modes = raw.get("modes", {})
    if isinstance(modes, dict):
        lists = {mode: edges for mode, edges in modes.items() if isinstance(edges, list)}
        parts["modes"] = {mode: tuple(edges) for mode, edges in lists.items()}
    else:
        problems.append(Problem("modes", "must be a table", "write [modes]"))
    return parts, problems


def _read_named(
    kind: type[schema.Section], raw: Any, name: str
) -> tuple[dict[str, Any], list[Problem]]:
    if not isinstance(raw, dict) or not raw:
        return {}, [Problem(name, "must hold named tables", f"write [{name}.NAME]")]
    sections: dict[str, Any] = {}
    problems: list[Problem] = []
    for key, table in raw.items():
        place = f"{name}.{key}"
        sections[key], more = (
            effects.read(table, place) if name == "effects" else read_section(kind, table, place)
        )
        problems += more
    return sections, problems


def _open_dbc(
    raw: Raw, folder: Path, problems: list[Problem]
) -> tuple[tuple[Place, ...], Catalog | None]:
    """The databases of [source] and what they say; what is wrong joins `problems` (in place)."""
    source = raw.get("source")
    name = source.get("dbc") if isinstance(source, dict) else None
    if not isinstance(name, str):
        if isinstance(source, dict) and "dbc" not in source and "time_column" not in source:
            remedy = 'add dbc = "machine.dbc" for CAN, or time_column = "t" for a table'
            problems.append(Problem("source.dbc", "missing", remedy))
        return (), None
    try:
        places = catalogs.places(name, folder)
        return places, catalogs.load(places).with_aliases(_aliases(raw))
    except catalogs.CatalogError as error:
        remedy = f'name a DBC relative to this file, or "{catalogs.BUILTIN}controller.dbc"'
        problems.append(Problem("source.dbc", str(error), remedy))
        return (), None


def _aliases(raw: Raw) -> dict[str, str]:
    """Messages of the file that are messages of the DBC by another name."""
    named = references.tables(raw, "messages").items()
    return {name: str(message["of"]) for name, message in named if "of" in message}


def _across(parts: dict[str, Any]) -> list[Problem]:
    """Checks of values that need more than one field; only for sections that are valid."""
    problems: list[Problem] = []
    for name, chamber in parts.get("chambers", {}).items():
        if chamber is not None and not chamber.net_area_m2() > 0:
            remedy = "give area_cm2, or a piston diameter larger than the rod"
            problems.append(Problem(f"chambers.{name}", "has no positive area", remedy))
    beta = parts.get("beta") or schema.BetaSection()
    if not beta.bounds_pa[0] <= beta.nominal_pa <= beta.bounds_pa[1]:
        problems.append(
            Problem("beta", "nominal lies outside bounds", "give bounds around nominal, one unit")
        )
    controller = parts.get("controller")
    if controller and controller.law == "robust" and controller.mass_kg is None:
        problems.append(Problem("controller.mass_kg", "missing", "law = 'robust' needs the mass"))
    problems += _publish(parts.get("publish") or schema.PublishSection(), parts)
    source = parts.get("source")
    unit = find_unit(source.time_unit) if source else None
    if source and (unit is None or unit.dimension != "time"):
        remedy = "use " + " or ".join(u.name for u in units_of("time"))
        problems.append(Problem("source.time_unit", f"{source.time_unit!r} is no time", remedy))
    return problems


def _publish(section: schema.PublishSection, parts: dict[str, Any]) -> list[Problem]:
    """Identifiers that belong together, and slots enough for all maps."""
    problems: list[Problem] = []
    if (section.can_id is None) != (section.reply_id is None):
        key = "can_id" if section.can_id is None else "reply_id"
        remedy = "the controller answers: give can_id and reply_id, or neither"
        problems.append(Problem(f"publish.{key}", "missing", remedy))
    if section.status and section.status_id is None:
        remedy = "add status_id = 0x702, or leave status out: then nothing is told"
        problems.append(Problem("publish.status_id", "missing", remedy))
    given = [i for i in (section.can_id, section.reply_id, section.status_id) if i is not None]
    if len(set(given)) < len(given):
        problems.append(
            Problem("publish.reply_id", "two identifiers are the same", "give each its own")
        )
    last = section.first_slot + len(parts.get("edges", {}))
    if last > 15:
        problems.append(
            Problem("publish.first_slot", f"the last slot would be {last}", "there are 0 to 15")
        )
    return problems


def _assemble(
    path: Path,
    sections: Sections,
    databases: tuple[Place, ...],
    catalog: Catalog | None,
    user_effects: tuple[Effect, ...],
) -> Project:
    model = build.build_model(sections, catalog)
    unknown = _noise_unknown(sections, model)
    _refuse_unfit(path, model.with_noise(dict.fromkeys(unknown, 1.0)))
    signals = sections.signals
    has_columns = all(s.column or s.constant is not None for s in signals.values())
    bus = build.build_assembly(sections, model, catalog, table=False) if catalog else None
    table = build.build_assembly(sections, model, catalog, table=True) if has_columns else None
    assembly = bus or table
    assert assembly is not None, "checked: without a DBC every signal has a column"
    edges = sections.edges.items()
    running = build.sums_of(model)
    return Project(
        path=path,
        sections=sections,
        model=model,
        assembly=assembly,
        table_assembly=table,
        databases=databases,
        reference_maps={n: path.parent / e.reference_map for n, e in edges if e.reference_map},
        noise_unknown=unknown,
        offset_tolerance_s={
            m.name: sections.messages[m.name].tolerance_s or m.period_s
            for m in assembly.messages
            if m.name in sections.messages and sections.messages[m.name].offset_s is None
        },
        digest=build.digest((model, build.feed(assembly, catalog if bus else None))),
        machine_digest=build.digest(model),
        effects=user_effects,
        flows=running,
        untrusted=_untrusted(path.parent, sections.project.effects_module),
    )


def _untrusted(folder: Path, module: str | None) -> Path | None:
    """The project's Python where it was not run; its place has been checked."""
    if module is None or trust.is_trusted((folder / module).read_bytes()):
        return None
    return folder / module


def _refuse_unfit(path: Path, model: Machine) -> None:
    """What the estimator cannot hold is wrong with the file: said here, before any work."""
    problems = [Problem(fault.where, fault.problem, fault.remedy) for fault in unfit(model)]
    if problems:
        raise ProjectError(path, problems)


def _noise_unknown(sections: Sections, model: Machine) -> tuple[str, ...]:
    kinds = {signal.name: signal.kind for signal in model.signals}
    return tuple(
        name
        for name, signal in sections.signals.items()
        if signal.noise is None and signal.constant is None and kinds[name] != "command"
    )
