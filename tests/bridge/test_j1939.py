"""J1939: a real truck, a hydraulic machine on a bus with foreign traffic, and every rule alone."""

from __future__ import annotations

import json
import re
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces import virtual

from firmware_bridge import catalog as catalogs
from firmware_bridge import frames as fr
from firmware_bridge.catalog import Catalog, CatalogError
from firmware_bridge.config import ANY, FOUND, MessageSource
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.j1939 import Network, known_as
from firmware_bridge.sources import blf, open_log
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.project import load
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.replay import replay
from rtid.study.study import Study
from tests.command import said

MACHINE, OTHER = 0x21, 0x33
MESSAGES = {  # name: PGN, bytes, signals with their first bit, factor, offset and unit
    "ValveCommand": (0xFF10, 8, {"U": (0, 0.001, -32.0, "V"), "PTank": (16, 500.0, 0.0, "Pa")}),
    "Motion": (0xFF11, 8, {"X": (24, 1e-5, 0.0, "m"), "V": (40, 1e-4, -3.2, "m/s")}),
    "Pressures": (
        0xFF12, 12,
        {"PA": (0, 500.0, 0.0, "Pa"), "PB": (56, 500.0, 0.0, "Pa"),
         "PSupply": (72, 500.0, 0.0, "Pa")},
    ),
}  # fmt: skip
COLUMNS = {
    "U": "u", "PTank": "p_tank", "X": "x", "V": "v", "PA": "p_a", "PB": "p_b",
    "PSupply": "p_supply",
}  # fmt: skip


def dbc(path: Path, plain: bool = False) -> Path:
    """The machine's messages, in parameter groups of any source or in plain frames of 8 bytes."""
    lines = ['VERSION ""', "BU_: C"]
    for name, (pgn, size, signals) in MESSAGES.items():
        can_id = pgn & 0xFF if plain else EXTENDED | 0x18000000 | pgn << 8 | 0xFE
        lines.append(f"\nBO_ {can_id} {name}: {8 if plain else size} C")
        for k, (signal, (bit, factor, offset, unit)) in enumerate(signals.items()):
            first = 16 * k if plain else bit
            scaled = f'({factor},{offset}) [0|0] "{unit}" C'
            lines.append(f" SG_ {signal} : {first}|16@1+ {scaled}")
    if not plain:
        lines += [
            '\nBA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";'
        ]
        lines += ['BA_DEF_DEF_ "VFrameFormat" "J1939PG";']
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> Catalog:
    return catalogs.load(dbc(tmp_path_factory.mktemp("dbc") / "machine.dbc"))


def frames_of(rows: list[tuple[float, int, bytes]]) -> Frames:
    """Frames of 29 bits from (ms, identifier, payload)."""
    out = fr.empty(len(rows))
    for k, (t_ms, can_id, payload) in enumerate(rows):
        out.t_us[k], out.can_id[k], out.length[k] = (
            round(1e3 * t_ms),
            can_id | EXTENDED,
            len(payload),
        )
        out.data[k, : len(payload)] = np.frombuffer(payload, np.uint8)
    return out


def group(pgn: int, source: int, priority: int = 6) -> int:
    return priority << 26 | pgn << 8 | source


def transport(
    t_ms: float, pgn: int, payload: bytes, source: int, to: int = 0xFF
) -> list[tuple[float, int, bytes]]:
    """A message in packets, to all (BAM) or, with its answers, to one (RTS/CTS)."""
    n = -(-len(payload) // 7)
    head = len(payload).to_bytes(2, "little") + bytes([n, 0xFF]) + pgn.to_bytes(3, "little")
    control, packet = group(0xEC00 | to, source, 7), group(0xEB00 | to, source, 7)
    rows = [(t_ms, control, bytes([32 if to == 0xFF else 16]) + head)]
    back = group(0xEC00 | source, to, 7)
    if to != 0xFF:
        rows.append((t_ms + 0.3, back, bytes([17, n, 1, 0xFF, 0xFF]) + pgn.to_bytes(3, "little")))
    for k in range(n):
        part = payload[7 * k : 7 * k + 7].ljust(7, b"\xff")
        rows.append((t_ms + 0.3 * len(rows), packet, bytes([k + 1]) + part))
    if to != 0xFF:
        rows.append((t_ms + 0.3 * len(rows), back, bytes([19]) + head))
    return rows


def network(catalog: Catalog, **addresses: int | str | None) -> Network:
    names = addresses or dict.fromkeys(catalog.names)
    return Network(catalog, [MessageSource(n, 0.01, address=a) for n, a in names.items()])


def test_a_truck_s_signals_are_read_by_their_names(shared: Path) -> None:
    folder = shared / "data/can_j1939"
    words = folder / "vehicle.mf4", "--dbc", folder / "j1939.dbc", "--json"
    code, out, _ = said("check", "--bus-only", *words)
    report = json.loads(out)
    assert code == 0 and report["frames"] == 150_411
    engine = next(s for s in report["signals"] if s["name"] == "EEC1.EngineSpeed")
    assert [engine[key] for key in ("unit", "count", "minimum", "maximum")] == ["rpm", 3993, 0, 0]
    named = {t["can_id"]: t["name"] for t in report["timing"]}
    assert named[0x0CF00400] == "EEC1" and named[0x18FEF100] == "CCVS1"
    (loose,) = (t["timing"] for t in report["timing"] if t["can_id"] == 0x0CF00300)
    assert [round(1e3 * loose[key], 1) for key in ("p01_s", "p99_s")] == [47.1, 53.0]
    assert round(1e3 * loose["worst_s"]) == 2014
    code, _, err = said("quick", words[0], *words[1:3])
    assert code == 3 and "EngineSpeed [rpm]" in err  # a truck is no cylinder


def test_priority_and_destination_say_nothing_and_the_source_is_given_found_or_any(
    catalog: Catalog,
) -> None:
    rows = [
        (float(k), group(0xFF11, source, priority), bytes(8))
        for k, (source, priority) in enumerate([(MACHINE, 6), (OTHER, 6), (MACHINE, 2), (OTHER, 0)])
    ]
    rows.append((9.0, 0x7FF, bytes(8)))
    frames = frames_of(rows)
    frames.can_id[4] = 0x7FF
    for address, count, others in ((None, 2, 2), (FOUND, 2, 2), (OTHER, 2, 2), (ANY, 4, 0)):
        out = network(catalog, Motion=address).push(frames)
        known = known_as(catalog, MessageSource("Motion", 0.01, address=address))
        assert (out.can_id == known).sum() == count
        assert out.refused == ({"other_source": others} if others else {})
        assert out.can_id[-1] == 0x7FF
    assert network(catalog, Motion=OTHER).push(frames).t_us[0] == 1000
    with pytest.raises(CatalogError, match="11 bits"):
        Network(catalogs.load(), [MessageSource("Motion", 0.01, address=3)])


def test_requests_and_address_claims_are_ignored_and_counted(catalog: Catalog) -> None:
    rows = [(0.0, group(0xEAFF, 3), b"\x11\xff\x00"), (1.0, group(0xEEFF, 3), bytes(8))]
    out = network(catalog).push(frames_of(rows))
    assert len(out) == 0
    assert out.refused == {"j1939_request": 1, "address_claim": 1}


@pytest.mark.parametrize("to", [0xFF, 0x42])
def test_packets_are_joined_and_what_is_broken_is_counted(catalog: Catalog, to: int) -> None:
    payload = bytes(range(12))
    whole = transport(0.0, 0xFF12, payload, MACHINE, to)
    foreign = transport(3.0, 0xFECA, bytes(20), OTHER, to)
    mixed = sorted(whole + transport(0.1, 0xFECA, bytes(20), OTHER, to))
    out = network(catalog).push(frames_of(mixed))
    assert out.data[0, :12].tobytes() == payload and out.length.tolist() == [12]
    assert out.t_us[0] == (600 if to == 0xFF else 900)  # the last packet
    assert out.refused == {"transport_foreign": 1}
    again = frames_of(whole + foreign)
    pieces = network(catalog)
    apart = fr.concatenate([pieces.push(again[k : k + 1]) for k in range(len(again))])
    assert np.array_equal(apart.data, out.data) and apart.t_us[0] == out.t_us[0]
    for gone in range(len(whole)):
        rows = [row for k, row in enumerate(whole) if k != gone]
        answer = to != 0xFF and gone in (1, len(whole) - 1)  # of the receiver: nobody needs it
        broken = network(catalog).push(frames_of(rows + whole))
        assert len(broken) == 1 + answer, gone
        lost = broken.refused.get("transport_broken", 0)
        assert lost == (0 if answer or gone == 0 else 1), gone
    aborted = [*whole[:-2], (5.0, group(0xEC00 | to, MACHINE), b"\xff" + whole[0][2][1:])]
    assert network(catalog).push(frames_of(aborted[:2] + aborted[-1:])).refused == {
        "transport_broken": 1
    }


def test_errors_and_values_that_are_not_available_are_missing(catalog: Catalog) -> None:
    data = np.zeros((5, 8), np.uint8)
    for row, raw in zip(data, (0x0000, 0xFAFF, 0xFB00, 0xFE00, 0xFFFF), strict=True):
        row[3:5] = raw & 0xFF, raw >> 8
    known = np.isfinite(catalog.layouts("Motion").decode(data)[:, 0])
    assert known.tolist() == [True, True, False, False, False]


def test_a_checksum_or_multiplexer_behind_byte_8_is_refused_by_name(tmp_path: Path) -> None:
    path = dbc(tmp_path / "m.dbc")
    path.write_text(
        path.read_text()
        .replace("PSupply : 72|16@", "PSupply m1 : 72|16@")
        .replace("PA :", "PA M :")
    )
    with pytest.raises(CatalogError, match="multiplexed"):
        catalogs.load(path).layouts("Pressures")


# A machine on J1939 against the same samples in plain frames


def payloads(name: str, columns: dict[str, np.ndarray], plain: bool) -> list[bytes]:
    _, size, signals = MESSAGES[name]
    data = np.full((len(columns["u"]), 8 if plain else size), 0xFF, np.uint8)
    for k, (signal, (bit, factor, offset, _)) in enumerate(signals.items()):
        raw = np.rint((columns[COLUMNS[signal]] - offset) / factor).astype("<u2")
        first = 2 * k if plain else bit // 8
        data[:, first : first + 2] = raw.view(np.uint8).reshape(-1, 2)
    return [row.tobytes() for row in data]


def as_bus(columns: dict[str, np.ndarray], plain: bool) -> Frames:
    """Command and position every 10 ms, pressures every 20 ms, on J1939 in packets to one."""
    rows: list[tuple[float, int, bytes]] = []
    for name, every, late_ms in (
        ("ValveCommand", 1, 0.0),
        ("Motion", 1, 0.2),
        ("Pressures", 2, 0.4),
    ):
        pgn = MESSAGES[name][0]
        for k, payload in list(enumerate(payloads(name, columns, plain)))[::every]:
            t_ms = 10.0 * k + late_ms
            if name == "Pressures" and not plain:
                rows += transport(t_ms, pgn, payload, MACHINE, 0x42)
            else:  # in plain frames with the stamp of the last packet
                stamp = t_ms + 0.9 if name == "Pressures" else t_ms
                rows.append((stamp, pgn & 0xFF if plain else group(pgn, MACHINE), payload))
    if not plain:
        rows += foreign(rows[-1][0], round(0.43 * len(rows)))
    frames = frames_of(sorted(rows, key=lambda row: row[0]))
    frames.can_id[:] &= np.uint32(0x7FF if plain else 0xFFFF_FFFF)
    return frames


def foreign(until_ms: float, n: int) -> list[tuple[float, int, bytes]]:
    """Others: their groups, requests, claims, long messages, and the machine's own groups."""
    rng = np.random.default_rng(3)
    rows: list[tuple[float, int, bytes]] = []
    while len(rows) < n:
        t_ms, kind = float(rng.uniform(5.0, until_ms)), rng.integers(5)
        payload = rng.integers(0, 256, 8, np.uint8).tobytes()
        pgn = (0xF004, 0xEA21, 0xEEFF, 0xFF11, 0)[kind]
        if kind < 4:
            rows.append((t_ms, group(pgn, OTHER), payload))
        else:
            rows += transport(t_ms, 0xFF12, bytes(12), OTHER + 1 + len(rows) % 100)
    return rows


def project_text(folder: Path, seconds: float) -> tuple[str, dict[str, np.ndarray]]:
    """A project of the simulated machine on such a bus, and its signals every 10 ms."""
    run = simulate(SimulatedPlant(), "rich", 0, seconds)
    columns = {name: run.samples.column(name)[::10] for name in COLUMNS.values()}
    write_run(folder / "run.parquet", run, 0, "rich")
    text = (folder / "run.toml").read_text().replace("builtin:controller.dbc", "machine.dbc")
    text = re.sub(r"(?m)^mode = .*", 'mode = "multirate"', text)
    for name, period in (("ValveCommand", 10), ("Motion", 10), ("Pressures", 20)):
        text = re.sub(
            rf"(?m)(^\[messages\.{name}\]\n(?:(?!\[).*\n)*)",
            f"[messages.{name}]\nperiod_ms = {period}\n\n",
            text,
        )
    return text, columns


def learned(folder: Path, columns: dict[str, np.ndarray], text: str, plain: bool) -> FlowMap:
    dbc(folder / "machine.dbc", plain)
    blf.write(folder / "run.blf", as_bus(columns, plain))
    (folder / "machine.toml").write_text(text)
    return Study(load(folder / "machine.toml"), folder / "run.blf").map


@pytest.mark.long
def test_a_machine_on_j1939_gives_the_maps_of_the_same_samples_on_plain_can(tmp_path: Path) -> None:
    text, columns = project_text(tmp_path, 40.0)
    folders = tmp_path / "plain", tmp_path / "j1939"
    for folder in folders:
        folder.mkdir()
    plain, mobile = (learned(f, columns, text, f.name == "plain") for f in folders)
    compared = 0
    for edge, other in zip(plain.edges, mobile.edges, strict=True):
        u, dp = np.meshgrid(edge.grid.u_v, edge.grid.dp_pa, indexing="ij")
        valid = (edge.status_at(u, dp) == VALID) & (other.status_at(u, dp) == VALID)
        difference = np.abs(edge.flow(u, dp) - other.flow(u, dp))[valid]
        assert difference.max(initial=0.0) < 1e-3 * np.abs(edge.flow(u, dp)).max()
        compared += int(valid.sum())
    assert compared > 20
    trace = replay(load(folders[1] / "machine.toml"), folders[1] / "run.blf").trace
    assert trace.counters["other_source"] > 100 and trace.counters["transport_foreign"] > 20
    assert trace.counters["j1939_request"] > 100
    code, out, err = said(
        "quick", folders[1] / "run.blf", "--dbc", folders[1] / "machine.dbc", "--json"
    )
    assert code in (0, 4), err
    assert "PSupply" in out
    assert len(open_log(folders[1] / "run.blf")) > len(columns["u"]) * 3


@pytest.mark.long
@pytest.mark.slow  # it waits for the bus
def test_the_daemon_learns_from_j1939_as_it_comes(tmp_path: Path) -> None:
    """`rtid run` on a virtual bus: long messages in packets, among others' traffic."""
    text, columns = project_text(tmp_path, 8.0)
    dbc(tmp_path / "machine.dbc")
    (tmp_path / "machine.toml").write_text(f"{text}\n[daemon]\nrate_hz = 100.0\nrecord_mb = 0\n")
    frames, is_over = as_bus(columns, plain=False), threading.Event()

    def send_in_time() -> None:
        """The frames with their own stamps, at the bus's pace, until the daemon has ended."""
        with can.Bus(interface="virtual", channel="j1939", preserve_timestamps=True) as bus:
            while len(virtual.channels["j1939"]) < 2 and not is_over.wait(0.05):
                pass  # nobody hears yet
            start_s = time.monotonic()
            for t_us, message in zip(frames.t_us, fr.to_messages(frames), strict=True):
                while 1e-6 * t_us > time.monotonic() - start_s and not is_over.wait(0.005):
                    pass
                if is_over.is_set():
                    return
                bus.send(message)

    sender = threading.Thread(target=send_in_time)
    sender.start()
    words = tmp_path / "machine.toml", "--bus", "virtual:j1939", "--test-bus", "--for", 3, "--json"
    try:
        code, out, err = said("run", *words, "--state", tmp_path / "state")
    finally:
        is_over.set()
        sender.join()
    assert code == 0, err
    status = json.loads(out.splitlines()[-1])
    assert status["estimate"]["samples"] > 100, status["estimate"]
    counts = status["estimate"]["refused"]
    assert counts["transport_foreign"] > 3 and counts["other_source"] > 20, counts
    assert not counts.get("silent") and not counts.get("transport_broken", 0) > 1, counts
