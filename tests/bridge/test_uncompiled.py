"""The kernels are plain Python too: without numba they must give the same samples."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.assemble import Assembler
from firmware_bridge.frames import Frames, concatenate
from firmware_bridge.sources import blf, candump, open_log, slcan_lines
from firmware_bridge.sources.serial_port import Decoder, encode
from firmware_bridge.stamps import StampModel
from firmware_bridge.steps import Continuous
from tests.bridge.machine import CATALOG, assembly, cycles
from tests.bridge.test_assemble import damaged

ROOT = Path(__file__).parents[2]

SCRIPT = """
import pathlib, sys, numba, numpy as np
def with_fields(a):
    if isinstance(a, tuple):
        return type(a)(*map(with_fields, a))
    return a.view(np.recarray) if isinstance(a, np.ndarray) and a.dtype.names else a
def njit(**_):  # numba gives records their fields as attributes; so does numpy.recarray
    return lambda f: lambda *arguments: f(*map(with_fields, arguments))
numba.njit = njit
from tests.bridge.test_uncompiled import digest
sys.stdout.write(digest(pathlib.Path(sys.argv[1])))
"""


NOISY_SLCAN = (
    b"t1212BEEF\rT000001231\xffA\rt1212BEEt1221AA\r\x07r1238\rd1239112233\r" + b"t1211AA0010\r" * 5
)


def stepped() -> Frames:
    """Frames whose clock is set back, then forward, mapped with and without arrivals."""
    frames = cycles(500)
    arrived_us = np.maximum.accumulate(frames.t_us + 300)
    frames.t_us[400:] -= 3_600_000_000
    frames.t_us[900:] += 3_600_000_000
    return concatenate([StampModel().push(frames, arrived_us), Continuous().push(frames)])


def digest(folder: Path) -> str:
    """All results of the bridge's kernels on a small damaged log, as one text."""
    lines = []
    for mode in ("cycle", "multirate"):
        assembler = Assembler(CATALOG, assembly(mode))
        samples = assembler.push(damaged(120, 1))
        lines += [samples.t_us.tobytes().hex(), samples.values.tobytes().hex()]
        lines += [samples.flags.tobytes().hex(), assembler.finish().values.tobytes().hex()]
        lines += [str(assembler.counters)]
    frames = cycles(40)
    blf.write(folder / "t.blf", frames)
    candump.write(folder / "t.log", frames)
    for found in (open_log(folder / "t.blf"), open_log(folder / "t.log"),
                  Decoder().push(b"\1\2\0" + encode(frames))):  # fmt: skip
        lines += [found.t_us.tobytes().hex(), found.data.tobytes().hex(), str(found.refused)]
    for clocked in (stepped(), slcan_lines.Decoder().push(NOISY_SLCAN)):
        lines += [clocked.t_us.tobytes().hex(), clocked.data.tobytes().hex(), str(clocked.refused)]
    return "\n".join(lines)


def test_uncompiled_kernels_give_the_same(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    plain = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", "-c", SCRIPT, str(tmp_path)],
        env=environment, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    if plain.returncode:
        pytest.fail(plain.stderr)
    assert plain.stdout == digest(tmp_path)
