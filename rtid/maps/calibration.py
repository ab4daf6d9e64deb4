"""Learned maps for calibration tools: DCM 2.0 (text) and ASAM CDF 2.0 (XML).

One map EDGE_flow per edge in L/min over the pressure drop in MPa (x) and the command in V (y), one
EDGE_flow_sd of its standard deviation, one EDGE_flow_status of what each node stands on, and the
bulk modulus of each chamber in MPa.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import rtid
from firmware_bridge.lookup import STATUS
from rtid.maps.gridded import Tables
from rtid.plain import FloatArray
from rtid.units import LPM, MPA

PER_LINE = 6
DOCTYPE = (
    '<!DOCTYPE MSRSW PUBLIC "-//ASAM//DTD CALIBRATION DATA FORMAT VERSION 2.0.0//EN" '
    '"cdf_v2.0.0.sl.dtd">'
)


@dataclass(frozen=True, eq=False)
class CalibrationMap:
    """One map of a calibration tool: values (y, x) over x_mpa (x,) and y_v (y,), in `unit`."""

    name: str
    about: str
    unit: str
    values: FloatArray  # (y, x)
    x_mpa: FloatArray
    y_v: FloatArray


def write_dcm(path: Path, tables: Tables, provenance: Mapping[str, Any]) -> None:
    """Write a DCM file; values to seven digits."""
    path.write_text("\n".join(_dcm(tables, provenance)) + "\n", encoding="utf-8")


def write_cdfx(path: Path, tables: Tables, provenance: Mapping[str, Any]) -> None:
    """Write a CDF 2.0 file; values to seven digits."""
    root = ET.Element("MSRSW", {"CREATOR": "rtid", "CREATOR-VERSION": rtid.__version__})
    _text(root, "SHORT-NAME", "flow_maps")
    introduction = ET.SubElement(root, "INTRODUCTION")
    _text(introduction, "P", json.dumps(dict(provenance), sort_keys=True))
    _text(root, "CATEGORY", "CDF20")
    system = ET.SubElement(ET.SubElement(root, "SW-SYSTEMS"), "SW-SYSTEM")
    _text(system, "SHORT-NAME", "rtid")
    spec = ET.SubElement(system, "SW-INSTANCE-SPEC")
    tree = ET.SubElement(spec, "SW-INSTANCE-TREE")
    _text(tree, "SHORT-NAME", "learned")
    _text(tree, "CATEGORY", "NO_VCD")
    for name, unit, value in calibration_values(provenance):
        _instance(tree, name, "effective bulk modulus", "VALUE", unit, [value])
    for table in calibration_maps(tables):
        _map_instance(tree, table)
    ET.indent(root)
    body = ET.tostring(root, encoding="unicode")
    path.write_text(f'<?xml version="1.0" encoding="utf-8"?>\n{DOCTYPE}\n{body}\n', "utf-8")


def calibration_maps(tables: Tables) -> Iterator[CalibrationMap]:
    """Flow, deviation and status of every edge."""
    codes = ", ".join(f"{k} {word}" for k, word in enumerate(STATUS))
    for g in tables:
        name, axes = f"{g.name}_flow", (MPA * g.dp_pa, g.u_v)
        yield CalibrationMap(name, f"flow of {g.name}", "L/min", LPM * g.flow_m3s, *axes)
        about = f"standard deviation of {name}"
        yield CalibrationMap(f"{name}_sd", about, "L/min", LPM * g.sd_m3s, *axes)
        about = f"{name} stands on: {codes}"
        yield CalibrationMap(f"{name}_status", about, "-", g.code, *axes)


def calibration_values(provenance: Mapping[str, Any]) -> Iterator[tuple[str, str, float]]:
    """Name, unit and value of each bulk modulus."""
    for k, beta_pa in enumerate(provenance.get("beta_pa", ())):
        yield f"beta_{k}", "MPa", MPA * float(beta_pa)


def _number(x: float) -> str:
    return f"{x:.7g}"


def _dcm(tables: Tables, provenance: Mapping[str, Any]) -> Iterator[str]:
    yield "* Flow maps learned by rtid, bilinear between the nodes"
    for key, value in sorted(provenance.items()):
        yield f"* {key}: {json.dumps(value)}"
    yield "KONSERVIERUNG_FORMAT 2.0"
    for name, unit, value in calibration_values(provenance):
        yield ""
        yield f"FESTWERT {name}"
        yield '   LANGNAME "effective bulk modulus"'
        yield f'   EINHEIT_W "{unit}"'
        yield f"   WERT {_number(value)}"
        yield "END"
    for table in calibration_maps(tables):
        yield ""
        yield f"KENNFELD {table.name} {len(table.x_mpa)} {len(table.y_v)}"
        yield f'   LANGNAME "{table.about}"'
        yield '   EINHEIT_X "MPa"'
        yield '   EINHEIT_Y "V"'
        yield f'   EINHEIT_W "{table.unit}"'
        yield from _rows("ST/X", table.x_mpa)
        for y, row in zip(table.y_v, table.values, strict=True):
            yield f"   ST/Y {_number(y)}"
            yield from _rows("WERT", row)
        yield "END"


def _rows(key: str, values: Iterable[float]) -> Iterator[str]:
    words = [_number(v) for v in values]
    for start in range(0, len(words), PER_LINE):
        yield f"   {key} {' '.join(words[start : start + PER_LINE])}"


def _map_instance(tree: ET.Element, table: CalibrationMap) -> None:
    instance = _instance(tree, table.name, table.about, "MAP", table.unit, table.values)
    axes = ET.SubElement(instance, "SW-AXIS-CONTS")
    for unit, values in (("MPa", table.x_mpa), ("V", table.y_v)):
        axis = ET.SubElement(axes, "SW-AXIS-CONT")
        _text(axis, "CATEGORY", "STD_AXIS")
        _text(axis, "UNIT-DISPLAY-NAME", unit)
        _numbers(ET.SubElement(axis, "SW-VALUES-PHYS"), values)


def _instance(
    tree: ET.Element, name: str, about: str, category: str, unit: str, values: Any
) -> ET.Element:
    instance = ET.SubElement(tree, "SW-INSTANCE")
    _text(instance, "SHORT-NAME", name)
    _text(instance, "LONG-NAME", about)
    _text(instance, "CATEGORY", category)
    content = ET.SubElement(instance, "SW-VALUE-CONT")
    _text(content, "UNIT-DISPLAY-NAME", unit)
    physical = ET.SubElement(content, "SW-VALUES-PHYS")
    if category == "VALUE":
        _numbers(physical, values)
    for row in values if category == "MAP" else ():
        _numbers(ET.SubElement(physical, "VG"), row)
    return instance


def _numbers(parent: ET.Element, values: Iterable[float]) -> None:
    for value in values:
        _text(parent, "V", _number(value))


def _text(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, tag).text = text
