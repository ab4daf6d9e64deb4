"""Learned maps as an A2L fragment (ASAP2 1.71): what DCM and CDFX hold values of, described.

One CHARACTERISTIC MAP per map of `calibration`, with its axes, units and record layout, and one
VALUE per bulk modulus.  Addresses are those of the linker: each has its name as SYMBOL_LINK.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from firmware_bridge.lookup import STATUS
from rtid.errors import RtidError
from rtid.maps.calibration import CalibrationMap, calibration_maps, calibration_values
from rtid.maps.gridded import Tables
from rtid.plain import FloatArray

LAYOUT_MAP, LAYOUT_VALUE = "rtid_map", "rtid_value"
CODES = "-"  # the unit of a status
METHODS = {"L/min": "rtid_L_min", "MPa": "rtid_MPa", "V": "rtid_V", CODES: "rtid_status"}
MOST_POINTS = 65_535


class NoA2lError(RtidError):
    """Maps that an A2L cannot describe; the text names the map."""


def write_a2l(path: Path, tables: Tables, provenance: Mapping[str, Any]) -> None:
    """Write the fragment.  Raises NoA2lError, OSError."""
    path.write_text("\n".join(_lines(tables, provenance)) + "\n", encoding="utf-8")


def _lines(tables: Tables, provenance: Mapping[str, Any]) -> Iterator[str]:
    said = json.dumps(dict(provenance), sort_keys=True).replace("*/", "* /")
    yield "ASAP2_VERSION 1 71"
    yield f"/* Flow maps learned by rtid: {said} */"
    yield '/begin PROJECT rtid "flow maps learned by rtid"'
    yield '/begin MODULE learned ""'
    yield '/begin MOD_COMMON "" BYTE_ORDER MSB_LAST ALIGNMENT_FLOAT32_IEEE 4 /end MOD_COMMON'
    for unit, method in METHODS.items():
        if unit != CODES:
            yield f'/begin COMPU_METHOD {method} "" IDENTICAL "%12.6" "{unit}" /end COMPU_METHOD'
    yield f'/begin COMPU_METHOD {METHODS[CODES]} "" TAB_VERB "%2.0" ""'
    yield "    COMPU_TAB_REF rtid_status_words /end COMPU_METHOD"
    words = " ".join(f'{k} "{word}"' for k, word in enumerate(STATUS))
    yield f'/begin COMPU_VTAB rtid_status_words "" TAB_VERB {len(STATUS)} {words} /end COMPU_VTAB'
    yield f"/begin RECORD_LAYOUT {LAYOUT_VALUE} FNC_VALUES 1 FLOAT32_IEEE ROW_DIR DIRECT"
    yield "/end RECORD_LAYOUT"
    yield f"/begin RECORD_LAYOUT {LAYOUT_MAP} NO_AXIS_PTS_X 1 UWORD NO_AXIS_PTS_Y 2 UWORD"
    yield "    AXIS_PTS_X 3 FLOAT32_IEEE INDEX_INCR DIRECT"
    yield "    AXIS_PTS_Y 4 FLOAT32_IEEE INDEX_INCR DIRECT"
    yield "    FNC_VALUES 5 FLOAT32_IEEE ROW_DIR DIRECT /end RECORD_LAYOUT"
    taken: set[str] = set()
    for name, unit, value in calibration_values(provenance):
        about = "effective bulk modulus"
        head = _head(_symbol(name, taken), about, "VALUE", LAYOUT_VALUE, unit, 0.0, 2 * value)
        yield f"{head} /end CHARACTERISTIC"
    for table in calibration_maps(tables):
        yield from _map(table, _symbol(table.name, taken))
    yield "/end MODULE"
    yield "/end PROJECT"


def _symbol(name: str, taken: set[str]) -> str:
    """A name that ASAP2 takes; NoA2lError where another one has become the same."""
    symbol = re.sub(r"\W", "_", name, flags=re.ASCII)
    symbol = symbol if symbol[:1].isalpha() or symbol[:1] == "_" else f"_{symbol}"
    if symbol in taken:
        raise NoA2lError(f"{name}: another map is called {symbol} too", "rename its edge")
    taken.add(symbol)
    return symbol


def _head(name: str, about: str, kind: str, layout: str, unit: str, low: float, high: float) -> str:
    if unit not in METHODS:
        raise NoA2lError(f"{name}: no conversion for the unit {unit}", "export .csv or .json")
    limits = f"{low:.7g} {high:.7g}"
    return (
        f'/begin CHARACTERISTIC {name} "{about}" {kind} 0x0 {layout} 0 {METHODS[unit]} {limits}\n'
        f'    SYMBOL_LINK "{name}" 0'
    )


def _map(table: CalibrationMap, name: str) -> Iterator[str]:
    low, high = float(table.values.min()), float(table.values.max())
    if table.unit == CODES:
        low, high = 0.0, len(STATUS) - 1.0
    yield _head(name, table.about, "MAP", LAYOUT_MAP, table.unit, low, high)
    for axis, unit in ((table.x_mpa, "MPa"), (table.y_v, "V")):
        yield _axis(name, axis, unit)
    yield "/end CHARACTERISTIC"


def _axis(name: str, axis: FloatArray, unit: str) -> str:
    if len(axis) > MOST_POINTS:
        raise NoA2lError(f"{name}: {len(axis)} points of an axis", "a coarser grid has fewer")
    return (
        f"    /begin AXIS_DESCR STD_AXIS NO_INPUT_QUANTITY {METHODS[unit]} {len(axis)} "
        f"{axis[0]:.7g} {axis[-1]:.7g} /end AXIS_DESCR"
    )
