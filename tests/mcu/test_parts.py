"""Look-up in floats and integers, map download and frames: on both boards the bytes of the host."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.c_tables import BOARD
from rtid.estimator.published import publish
from rtid.maps.c_header import write_header
from rtid.mcu.c_tables import SOURCES
from rtid.mcu.emulated import FLAGS, GCC, M4, M7, QEMU, absent
from rtid.sim.bus import run_frames
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.bridge.tables import a_table
from tests.flow_maps import machine, orifice, solved
from tests.mcu.compiled import COMPILER, STRICT
from tests.mcu.test_example import download_frames

HERE = Path(__file__).parent
PARTS = ("rtid_map.c", "rtid_map_fixed.c", "rtid_download.c", "rtid_frames.c")
FRAME = np.dtype(
    [("t_us", np.int64), ("can_id", np.uint32), ("length", np.uint8), ("data", np.uint8, (8,))],
    align=True,
)
POINTS = 3000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables, points beyond all ends, a download with damaged and repeated frames, CAN frames."""
    if lacking := absent():
        pytest.skip(f"no {lacking} on this machine: the controller is not emulated")
    if COMPILER is None:
        pytest.skip("no cc, gcc or clang on this machine: the C is not compiled")
    here, rng = tmp_path_factory.mktemp("parts"), np.random.default_rng(0)
    write_header(
        here / "maps.h", machine(edges=2), publish(solved(machine(edges=2), orifice, rng)), {}
    )
    points = rng.uniform(-1.0, 1.0, (POINTS, 3)) * [12.0, 30e6, 2e-3]
    points.astype(np.float32).tofile(here / "points.bin")
    sent = download_frames(a_table(12, 9))
    for k in range(20, len(sent), 40):
        sent[k:k] = [sent[k], sent[k][:3] + b"\xff" + sent[k][4:]]
    (here / "downloads.bin").write_bytes(b"".join(sent))
    taken = run_frames(simulate(SimulatedPlant(), "rich", seed=3, duration_s=0.5))
    frames = np.zeros(len(taken), FRAME)
    frames["t_us"], frames["can_id"], frames["length"] = taken.t_us, taken.can_id, taken.length
    frames["data"] = taken.data[:, :8]
    frames["data"][::17, 5] ^= 1
    frames.tofile(here / "frames.bin")
    return here


@pytest.fixture(scope="module")
def on_host(folder: Path) -> bytes:
    """What the program makes of it here."""
    assert COMPILER is not None
    sources = [HERE / "parts.c", HERE / "host.c", *(SOURCES / name for name in PARTS)]
    places = [f"-I{BOARD}", f"-I{SOURCES}", f"-I{folder}"]
    flags = [flag for flag in STRICT if flag != "-std=c99"]  # read and write are POSIX's
    command = [COMPILER, "-std=gnu99", "-ffp-contract=off", *flags, *places, *map(str, sources)]
    subprocess.run([*command, "-O2", "-o", "host", "-lm"], check=True, cwd=folder)
    subprocess.run([str(folder / "host")], check=True, cwd=folder)
    return (folder / "out.bin").read_bytes()


@pytest.mark.parametrize("board", [M4, M7], ids=["M4", "M7"])
def test_the_same_bytes_on_the_board(
    folder: Path, on_host: bytes, board: tuple[str, tuple[str, ...]]
) -> None:
    sources = [HERE / "parts.c", BOARD / "board.c", *(SOURCES / name for name in PARTS)]
    places = [f"-I{BOARD}", f"-I{SOURCES}", f"-I{folder}", f"-T{BOARD / 'board.ld'}"]
    command = [GCC, *FLAGS, *STRICT, *board[1], *places, "-nostartfiles", "--specs=nosys.specs"]
    subprocess.run([*command, *map(str, sources), "-o", "board.elf", "-lm"], check=True, cwd=folder)
    options = ["-nographic", "-icount", "shift=0", "-kernel", "board.elf"]
    options += ["-semihosting-config", "enable=on,target=native"]
    subprocess.run([QEMU, "-M", board[0], *options], check=True, cwd=folder, timeout=200)
    assert (folder / "out.bin").read_bytes() == on_host


def test_what_the_host_makes_is_no_silence(folder: Path, on_host: bytes) -> None:
    """The map arrived: its flows are those of Python's table; frames were refused and taken."""
    one = 32 * POINTS
    points = np.fromfile(folder / "points.bin", np.float32).reshape(-1, 3)
    n_frames = (folder / "frames.bin").stat().st_size // FRAME.itemsize
    record = np.dtype(
        [("told", np.int32, (2,)), ("values", float, (3,)), ("wire", np.uint8, (25,))]
    )
    checked = np.frombuffer(on_host[-n_frames * record.itemsize :], record)
    assert {-1, 2} <= set(checked["told"][:, 0].tolist())
    after = on_host[-n_frames * record.itemsize - one : -n_frames * record.itemsize]
    told = np.frombuffer(after, np.int32).reshape(-1, 8)
    flow, status = a_table(12, 9).flow(points[:, 0], points[:, 1])
    assert np.array_equal(told[:, 0], status)
    assert told[:, 2].copy().view(np.float32) == pytest.approx(flow, rel=1e-5, abs=1e-9)
    assert len(np.unique(told[:, 0])) > 3
