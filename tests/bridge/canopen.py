"""A cylinder whose valve, pressure sensors and encoder are nodes of CANopen: EDS, DCF, frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames

VALVE, SENSOR, ENCODER = 5, 9, 10
BAR, STEP_NM = 0x004E0000, 10_000

Object = tuple[str, int | None, int | str | None]  # name, data type, default value


def eds(path: Path, objects: dict[tuple[int, int | None], Object], node: int | None = None) -> Path:
    """An EDS of these objects, by index and subindex (None: no parts); a DCF, of one node."""
    lines = ["; by hand", "[FileInfo]", f"FileName={path.name}", "[DeviceInfo]", "Granularity=8"]
    if node is not None:
        lines += ["[DeviceComissioning]", f"NodeID={node}"]
    for (index, sub), (name, kind, value) in objects.items():
        lines.append(f"[{index:04X}]" if sub is None else f"[{index:04X}sub{sub:x}]")
        lines += [f"ParameterName={name}", f"DataType=0x{kind:04X}"] if kind else []
        lines += [f"ParameterName={name}"] if not kind else []
        lines += [f"DefaultValue={value}"] if value is not None else []
    path.write_text("\n".join(lines) + "\n")
    return path


def record(index: int, name: str, values: list[Object]) -> dict[tuple[int, int | None], Object]:
    whole: dict[tuple[int, int | None], Object] = {(index, None): (name, None, None)}
    whole[index, 0] = ("Highest sub-index supported", 5, len(values))
    return whole | {(index, k): value for k, value in enumerate(values, 1)}


def pdo(
    sent: int, cob_id: str, mapped: list[int], timer_ms: int = 10
) -> dict[tuple[int, int | None], Object]:
    """A PDO of these entries; sent: its object of communication."""
    said: list[Object] = [("COB-ID", 7, cob_id), ("Type", 5, 255), ("Inhibit", 6, 0), ("", 5, 0)]
    return record(sent, "PDO", [*said, ("Event timer", 6, timer_ms)]) | record(
        sent + 0x200, "PDO mapping", [(f"Entry {k}", 7, f"0x{m:08X}") for k, m in enumerate(mapped)]
    )


def machine(folder: Path) -> str:
    """Three nodes; the names of their files as `--dbc` takes them."""
    valve = pdo(0x1400, "$NODEID+0x200", [0x6040_0010, 0x6300_0110])
    valve |= {(0x6040, None): ("Device control word", 6, 0)}
    valve |= record(0x6300, "vpoc set point", [("Value", 3, 0)])
    sensor = pdo(0x1800, "$NODEID + 0x180", [0x7130_0110, 0x7130_0210, 0x7130_0310])
    sensor |= pdo(0x1801, "$NODEID+0x80000280", [0x7130_0110])  # switched off
    names = ("Cylinder piston pressure", "Cylinder rod pressure", "Pump pressure")
    sensor |= record(0x7130, "AI Input PV", [(name, 3, None) for name in names])
    sensor |= record(0x6131, "AI Physical Unit PV", [("unit", 7, BAR)] * 3)
    sensor |= record(0x6132, "AI Decimal Digits PV", [("digits", 5, 2)] * 3)
    encoder = pdo(0x1800, "0x18A", [0x6004_0020, 0x0005_0008, 0x6030_0010])
    encoder |= {(0x6004, None): ("Position Value", 7, None)}
    encoder |= record(0x6030, "Speed Value", [("Speed Value Channel 1", 3, None)])
    encoder |= record(0x6005, "Step", [("Position step", 7, STEP_NM), ("Speed step", 7, 10)])
    encoder[0x1A00, 3] = ("Entry 3", 7, "0x60300110")
    eds(folder / "valve.eds", valve)
    eds(folder / "sensor.eds", sensor)
    eds(folder / "encoder.dcf", encoder, ENCODER)
    return ",".join(
        [f"{folder}/valve.eds:{VALVE}", f"{folder}/sensor.eds:{SENSOR}", f"{folder}/encoder.dcf"]
    )


def bus(columns: dict[str, np.ndarray]) -> Frames:
    """Each node's frame every 10 ms, one behind the other."""
    n = len(columns["u"])
    out, words = fr.empty(3 * n), np.zeros((3 * n, 4), "<i2")
    for k, (can_id, length) in enumerate(((0x205, 4), (0x189, 6), (0x18A, 7))):
        out.t_us[k::3] = 10_000 * np.arange(n) + 150 * k
        out.can_id[k::3], out.length[k::3] = can_id, length
    words[0::3, 1] = np.rint(1000 * columns["u"])
    for k, name in enumerate(("p_a", "p_b", "p_supply")):
        words[1::3, k] = np.rint(1e-3 * columns[name])
    out.data[:] = words.view(np.uint8)
    position = np.rint(columns["x"] * 1e9 / STEP_NM).astype("<u4").view(np.uint8)
    out.data[2::3, :4] = position.reshape(-1, 4)
    out.data[2::3, 5:7] = np.rint(1e4 * columns["v"]).astype("<i2").view(np.uint8).reshape(-1, 2)
    return out
