"""The firmware's C against Python, byte for byte in both directions, also under sanitizers."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from firmware_bridge import c_tables, checks, encode
from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.catalog import Catalog, CatalogError, load
from firmware_bridge.config import Assembly, SignalSource
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources import serial_port
from firmware_bridge.sources.serial_port import Decoder
from tests.bridge.machine import CATALOG, MESSAGES, START_US, equal
from tests.bridge.test_assemble import damaged
from tests.bridge.wire import KINDS, noisy

HERE = Path(__file__).parent
SOURCES = Path(c_tables.HEADER).parent
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
BUILDS = {
    "optimised": ("-O2",),
    "sanitised": ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
}
COMPILER = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
VALUES = {name: c_tables._value_names(CATALOG, name) for name in MESSAGES}

FRAME = np.dtype(
    [("t_us", "<i8"), ("can_id", "<u4"), ("length", "u1"), ("data", "u1", 8)], align=True
)
ORDER = np.dtype([("t_us", "<i8"), ("message", "<i4"), ("counter", "<u4"), ("values", "<f8", 3)])
RESULT = np.dtype([("verdict", "<i4"), ("message", "<i4"), ("values", "<f8", 3)])
N_REASONS = 7
Records = NDArray[Any]
Run = Callable[[str, bytes], bytes]


@pytest.fixture(scope="module", params=BUILDS)
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The compiled harness: mode and standard input to standard output."""
    if COMPILER is None:
        pytest.skip("no cc, gcc or clang on this machine: the firmware's C is not tested")
    program = tmp_path_factory.mktemp("c") / "harness"
    sources = [str(HERE / "harness.c"), str(SOURCES / "rtid_frames.c")]
    subprocess.run(
        [COMPILER, *STRICT, *BUILDS[request.param], f"-I{SOURCES}", *sources, "-o", str(program)],
        check=True,
    )

    def call(mode: str, stdin: bytes) -> bytes:
        done = subprocess.run(
            [program, mode], input=stdin, capture_output=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr.decode()
        return done.stdout

    return call


def as_records(frames: Frames) -> Records:
    out = np.zeros(len(frames), FRAME)
    for name in FRAME.names or ():
        out[name] = getattr(frames, name)
    return out


def as_frames(records: Records) -> Frames:
    out = fr.empty(len(records))
    for name in FRAME.names or ():
        getattr(out, name)[:] = records[name]
    return out


def hard_values(name: str, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Values (n, 3) of a message: random, at and around counts and borders, absent, absurd."""
    layouts = CATALOG.layouts(name, VALUES[name])
    out = np.empty((n, len(layouts.names)))
    for k, row in enumerate(layouts.rows):
        low, high, scale = float(row["minimum"]), float(row["maximum"]), float(row["scale"])
        counts = np.rint(rng.uniform(low, high, n) / scale)
        choices = [
            rng.uniform(low - 0.1 * abs(high), 1.1 * high, n),
            counts * scale,
            (counts + 0.5) * scale,  # halves go to the even count
            np.nextafter((counts + 0.5) * scale, rng.choice([-np.inf, np.inf], n)),
            rng.choice([low, high, low + scale / 2, high - scale / 2, 0.0, -0.0], n),
            rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324], n),
        ]
        out[:, k] = np.choose(rng.choice(6, n, p=[0.3, 0.2, 0.2, 0.1, 0.1, 0.1]), choices)
    return out


@pytest.mark.parametrize("name", MESSAGES)
def test_packs_as_python_does(run: Run, name: str) -> None:
    n, rng = 20_000, np.random.default_rng(len(name))
    values, t_us = hard_values(name, n, rng), START_US + 1000 * np.arange(n)
    orders = np.zeros(n, ORDER)
    orders["t_us"], orders["message"], orders["values"] = t_us, MESSAGES.index(name), values
    orders["counter"] = np.arange(n) % 256
    got = np.frombuffer(run("pack", orders.tobytes()), FRAME)
    columns = dict(zip(VALUES[name], values.T, strict=True))
    assert equal(as_frames(got), encode.encode_message(CATALOG, name, t_us, columns))


@njit
def verdicts(plan: Any, last: Any, t_us: Any, can_id: Any, length: Any, words: Any, counts: Any,
             codes: Any, values: Any) -> None:  # fmt: skip
    """`checks.admit` frame by frame, as the assemblers call it."""
    messages, roles, layouts, absent, tables = plan
    for i in range(len(t_us)):
        m = checks.find_message(messages, can_id[i], 0)
        if m < 0:
            counts[checks.UNKNOWN_ID] += 1
            codes[i] = checks.UNKNOWN_ID
            continue
        codes[i] = checks.admit(
            messages[m], last[m], roles, layouts, absent, tables,
            t_us[i], length[i], words[i], values[i], counts,
        )  # fmt: skip


def python_verdicts(frames: Frames) -> tuple[Records, NDArray[np.int64]]:
    """Verdict of every frame and counts by reason, with all signals wanted."""
    signals = tuple(
        SignalSource(f"{name}.{signal}", name, signal)
        for name in MESSAGES
        for signal in VALUES[name]
    )
    messages = tuple(CATALOG.message_source(name) for name in MESSAGES)
    plan = Assembler(CATALOG, Assembly("cycle", signals, messages, "Motion.X"))._plan
    last, counts = np.zeros(len(MESSAGES), checks.LAST), np.zeros(len(checks.REASONS), np.int64)
    codes = np.zeros(len(frames), np.int32)
    words = np.ascontiguousarray(frames.data).view("<u8")[:, 0]
    verdicts(plan, last, frames.t_us, frames.can_id, frames.length, words, counts, codes,
             np.zeros((len(frames), 9)))  # fmt: skip
    return codes, counts[:N_REASONS]


def corrupted(seed: int) -> Frames:
    """15,000 frames with every kind of damage, also behind a good CRC."""
    rng = np.random.default_rng(seed)
    frames = damaged(5000, seed)
    hard = [
        encode.encode_message(
            CATALOG, name, START_US + 5_000_000 + 1000 * np.arange(1500),
            dict(zip(VALUES[name], hard_values(name, 1500, rng).T, strict=True)),
        )
        for name in MESSAGES
    ]  # fmt: skip
    frames = fr.concatenate([frames, fr.by_time(fr.concatenate(hard))])
    bits = rng.random((len(frames), 64)) < 0.3
    hit = rng.random(len(frames)) < 0.1
    frames.data[hit] ^= np.packbits(bits[hit], axis=1)
    frames.t_us[rng.integers(0, len(frames), 100)] += rng.integers(-20_000, 20_000, 100)
    return frames


@pytest.mark.parametrize("seed", [1, 2])
def test_judges_as_python_does(run: Run, seed: int) -> None:
    frames = corrupted(seed)
    out = run("check", as_records(frames).tobytes())
    results = np.frombuffer(out[: len(frames) * RESULT.itemsize], RESULT)
    codes, counts = python_verdicts(frames)
    np.testing.assert_array_equal(results["verdict"], codes)
    np.testing.assert_array_equal(np.frombuffer(out[-4 * N_REASONS :], "<u4"), counts)
    assert (counts > 20).all(), "every reason occurs"

    for m, name in enumerate(MESSAGES):
        admitted = (results["message"] == m) & np.isin(codes, [checks.OK, checks.NOT_AVAILABLE])
        expected = CATALOG.layouts(name, VALUES[name]).decode(frames.data[admitted])
        np.testing.assert_array_equal(results["values"][admitted], expected)


def any_frames(n: int, seed: int) -> Frames:
    rng = np.random.default_rng(seed)
    frames = fr.empty(n)
    standard = rng.integers(0, 2**11, n, np.uint32)
    extended = rng.integers(EXTENDED, EXTENDED + 2**29, n, np.uint32)
    frames.can_id[:] = np.where(rng.random(n) < 0.5, standard, extended)
    frames.t_us[:] = rng.integers(0, 2**53, n) >> rng.integers(0, 53, n)
    frames.length[:] = rng.integers(0, 9, n)
    raw = rng.integers(0, 256, (n, 8)) * (rng.random((n, 8)) < 0.7)  # many zeros for COBS
    frames.data[:] = np.where(np.arange(8) < frames.length[:, None], raw, 0)
    return frames


def test_writes_the_serial_line_as_python_does(run: Run) -> None:
    frames = any_frames(15_000, 0)
    assert run("encode", as_records(frames).tobytes()) == serial_port.encode(frames)


@pytest.mark.parametrize("kind", [None, *KINDS])
def test_reads_the_serial_line_as_python_does(run: Run, kind: str | None) -> None:
    frames = any_frames(15_000, 1)
    stream = serial_port.encode(frames)
    if kind is not None:
        stream = noisy(stream, 20_000, 3, kind)[0] + b"\1" * 300 + b"\0" + stream[:1000]
    out, expected = run("decode", stream), Decoder().push(stream)
    got = as_frames(np.frombuffer(out[:-4], FRAME))
    assert equal(got, expected)
    assert int.from_bytes(out[-4:], "little") == expected.refused.get("bad_serial_frame", 0)
    assert kind is not None or equal(got, frames)


def test_tables_are_those_of_the_dbc() -> None:
    renew = "renew it: python -m firmware_bridge.c_tables > firmware_bridge/c/rtid_tables.h"
    assert c_tables.HEADER.read_text() == c_tables.tables(CATALOG), renew


DBC = """VERSION ""
BO_ 256 M: 8 Vector__XXX
 SG_ Crc : 0|8@1+ (1,0) [0|255] "" Vector__XXX
 SG_ AliveCounter : 8|4@1+ (1,0) [0|15] "" Vector__XXX
 SG_ X : {} "" Vector__XXX
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 {};
VAL_ 256 X 127 "NotAvailable" ;
"""


def dbc(tmp_path: Path, signal: str, period: int = 10) -> Catalog:
    path = tmp_path / "m.dbc"
    path.write_text(DBC.format(signal, period))
    return load(path)


def test_another_dbc_gets_tables_of_its_own(tmp_path: Path) -> None:
    text = c_tables.tables(dbc(tmp_path, "16|8@1- (0.5,3) [-10|10]"), ["M"])
    assert "enum { RTID_M_X };" in text
    assert "{0x00000100u, 15000, 0x0000u, 0, 1, 8, 0, 8, 4}" in text
    assert "{16, 8, 1, -26, 14, 0.5, 3.0}" in text


@pytest.mark.parametrize(
    ("signal", "period", "message"),
    [
        ("23|8@0+ (1,0) [0|100]", 10, "little-endian integers"),
        ("16|8@1+ (1,0) [0|255]", 10, "code for not available"),
        ("16|8@1+ (1,0) [0|100]", 0, "needs GenMsgCycleTime"),
    ],
)
def test_what_the_c_does_not_know_is_refused(
    tmp_path: Path, signal: str, period: int, message: str
) -> None:
    with pytest.raises(CatalogError, match=message):
        c_tables.tables(dbc(tmp_path, signal, period), ["M"])
