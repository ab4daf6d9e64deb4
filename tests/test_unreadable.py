"""What stands in the place of a file: nothing waits for it, and it costs one plain message."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

SUFFIXES = (
    ".blf", ".log", ".asc", ".trc", ".csv", ".mf4", ".parquet", ".tsv", ".txt", ".mat", ".dbc",
    ".sym", ".toml", ".npz", ".gz", ".xyz",
)  # fmt: skip
PLACES = ("absent", "empty", "byte", "folder", "fifo", "loop", "device")
HANG_S = 300  # of a loaded machine that compiles everything first
PROGRAM = """
import contextlib, io, json, sys
from rtid.cli.main import run
told = []
for arguments in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            run(arguments)
    except SystemExit as ended:
        told.append([arguments, int(ended.code or 0), err.getvalue()])
    except BaseException as error:
        told.append([arguments, -1, repr(error)])
print(json.dumps(told))
"""


def stand(path: Path, place: str) -> None:
    """Put it there; "device" is a file that opens and cannot be read."""
    if place == "empty":
        path.touch()
    elif place == "byte":
        path.write_bytes(b"x")
    elif place == "folder":
        path.mkdir()
    elif place == "fifo":
        os.mkfifo(path)
    elif place == "loop":
        path.symlink_to(path)
    elif place == "device":
        path.symlink_to("/proc/self/mem")


def test_no_reader_hangs_or_crashes_on_what_is_no_file(tmp_path: Path) -> None:
    commands = []
    for place in PLACES:
        folder = tmp_path / place
        folder.mkdir()
        for suffix in SUFFIXES:
            path = str(folder / f"it{suffix}")
            stand(Path(path), place)
            commands += [["check", "--bus-only", path], ["quick", path]]
            commands += [["init", path, "-o", str(tmp_path / "out.toml"), "--force"]]
            commands += [["check", path]] if suffix == ".toml" else []
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], input=json.dumps(commands), capture_output=True,
        text=True, check=True, timeout=HANG_S,
    )  # fmt: skip
    told = json.loads(done.stdout)
    assert len(told) == len(commands)
    for arguments, code, said in told:
        assert code in (2, 3), (arguments, said)
        assert said.strip().startswith(("rtid: ", "/")), (arguments, said)
