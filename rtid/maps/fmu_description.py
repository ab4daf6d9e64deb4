"""modelDescription.xml of an FMU, by FMI 2.0 and 3.0, from one list of variables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import rtid

BASE = {  # exponents of kg, m, s, A, K of the units that we use
    "Pa": {"kg": 1, "m": -1, "s": -2}, "Pa/s": {"kg": 1, "m": -1, "s": -3},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1}, "A": {"A": 1}, "m": {"m": 1},
    "m/s": {"m": 1, "s": -1}, "m3/s": {"m": 3, "s": -1}, "s": {"s": 1}, "K": {"K": 1},
    "N": {"kg": 1, "m": 1, "s": -2}, "N/s": {"kg": 1, "m": 1, "s": -3},
    "m/s/s": {"m": 1, "s": -2}, "K/s": {"K": 1, "s": -1},
}  # fmt: skip
KINDS = {  # causality, variability, initial
    "input": ("input", "continuous", ""),
    "command": ("input", "discrete", ""),
    "state": ("output", "continuous", "exact"),
    "parameter": ("parameter", "tunable", "exact"),
    "output": ("output", "continuous", "calculated"),
    "status": ("output", "discrete", "calculated"),
}
WHOLE = "status"
TOKEN = {2: "guid", 3: "instantiationToken"}


@dataclass(frozen=True)
class FmuVariable:
    """One variable: reference is its place in the C model; kind: one of KINDS; SI unit."""

    name: str
    reference: int
    kind: str
    unit: str
    about: str
    start: float | None = None


def described(
    version: int,
    identifier: str,
    token: str,
    variables: Sequence[FmuVariable],
    sources: Iterable[str],
    about: str,
) -> dict[str, str]:
    """The XML files of an FMU by their places in it; token: what the binary must be asked with."""
    root = ET.Element("fmiModelDescription", {
        "fmiVersion": f"{version}.0", "modelName": identifier, TOKEN[version]: token,
        "description": about, "generationTool": f"rtid {rtid.__version__}",
        "variableNamingConvention": "flat",
    })  # fmt: skip
    state = "canGetAndSetFMUstate" if version == 2 else "canGetAndSetFMUState"
    serial = state.replace("GetAndSet", "Serialize")
    able = {
        "modelIdentifier": identifier, "canHandleVariableCommunicationStepSize": "true",
        state: "true", serial: "true",
    }  # fmt: skip
    if version == 2:
        able["canInterpolateInputs"] = "true"
    unit = ET.SubElement(root, "CoSimulation", able)
    files = {}
    if version == 2:
        listed = ET.SubElement(unit, "SourceFiles")
        for name in sources:
            ET.SubElement(listed, "File", {"name": name})
    else:
        files["sources/buildDescription.xml"] = _build_description(identifier, sources)
    _units(root, variables)
    body = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    write = _by_two if version == 2 else _by_three
    write(body, structure, variables)
    return {"modelDescription.xml": _text(root), **files}


def _build_description(identifier: str, sources: Iterable[str]) -> str:
    root = ET.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = ET.SubElement(root, "BuildConfiguration", {"modelIdentifier": identifier})
    files = ET.SubElement(build, "SourceFileSet", {"language": "C99"})
    for name in sources:
        ET.SubElement(files, "SourceFile", {"name": name})
    ET.SubElement(files, "PreprocessorDefinition", {"name": "FMI_VERSION", "value": "3"})
    return _text(root)


def _units(root: ET.Element, variables: Sequence[FmuVariable]) -> None:
    units = ET.SubElement(root, "UnitDefinitions")
    for name in dict.fromkeys(v.unit for v in variables if v.unit):
        unit = ET.SubElement(units, "Unit", {"name": name})
        if name in BASE:
            ET.SubElement(unit, "BaseUnit", {k: str(n) for k, n in BASE[name].items()})


def _common(variable: FmuVariable) -> dict[str, str]:
    causality, variability, initial = KINDS[variable.kind]
    return {
        "name": variable.name, "valueReference": str(variable.reference),
        "description": variable.about, "causality": causality, "variability": variability,
    } | ({"initial": initial} if initial else {})  # fmt: skip


def _value(variable: FmuVariable) -> dict[str, str]:
    unit = {"unit": variable.unit} if variable.unit else {}
    return unit | ({} if variable.start is None else {"start": repr(float(variable.start))})


def _is_output(variable: FmuVariable) -> bool:
    return KINDS[variable.kind][0] == "output"


def _by_two(body: ET.Element, structure: ET.Element, variables: Sequence[FmuVariable]) -> None:
    outputs = ET.SubElement(structure, "Outputs")
    unknown = ET.SubElement(structure, "InitialUnknowns")
    for index, variable in enumerate(variables, 1):
        scalar = ET.SubElement(body, "ScalarVariable", _common(variable))
        ET.SubElement(scalar, "Integer" if variable.kind == WHOLE else "Real", _value(variable))
        if _is_output(variable):
            ET.SubElement(outputs, "Unknown", {"index": str(index)})
            if KINDS[variable.kind][2] == "calculated":
                ET.SubElement(unknown, "Unknown", {"index": str(index)})


def _by_three(body: ET.Element, structure: ET.Element, variables: Sequence[FmuVariable]) -> None:
    time = {"name": "time", "valueReference": "0", "causality": "independent"}
    ET.SubElement(body, "Float64", time | {"variability": "continuous"})
    calculated = []
    for variable in variables:
        tag = "Int32" if variable.kind == WHOLE else "Float64"
        ET.SubElement(body, tag, _common(variable) | _value(variable))
        if _is_output(variable):
            ET.SubElement(structure, "Output", {"valueReference": str(variable.reference)})
            if KINDS[variable.kind][2] == "calculated":
                calculated.append(variable.reference)
    for reference in calculated:
        ET.SubElement(structure, "InitialUnknown", {"valueReference": str(reference)})


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'
