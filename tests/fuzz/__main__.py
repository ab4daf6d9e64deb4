"""`make fuzz`: mutated projects, DBCs, logs, tables and plant files, each through its command.

Each case runs in a fork of a warm process, so that a hang, a crash or a bomb costs only itself.
Prints a table, writes each input that failed into a folder, and ends with 1 if any did.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: threads do not survive a fork
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pyarrow as pa

from tests.fuzz.cases import KINDS, Case, make
from tests.fuzz.command import call
from tests.fuzz.forked import MOST_CPU_S, Running, Verdict
from tests.fuzz.judge import judge
from tests.fuzz.seeds import Seeds
from tests.fuzz.seeds import make as make_seeds

SIZES = {
    "projects": 500, "dbcs": 500, "nodes": 500, "logs": 5000, "tables": 3000, "plants": 200,
    "bombs": 8,
}  # fmt: skip
TIMES = 2.0  # what a sound table takes: no hang, where a slow machine takes that long
DEFECTS = ("traceback", "hang", "memory", "crash", "loss", "output")


def main() -> int:
    """Run the cases that the command line asks for."""
    asked = _arguments()
    scratch = Path(tempfile.mkdtemp(prefix="rtid-fuzz-"))
    try:
        seeds = make_seeds(_made(scratch / "seeds"))
        sound_s = _warm(seeds, scratch, asked.kinds)
        verdicts = list(_run(seeds, asked, scratch, max(1.0, TIMES * sound_s / MOST_CPU_S)))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    print(table(verdicts))
    failed = [v for v in verdicts if v.defect]
    print("\n".join(groups(failed)))
    if failed:
        print(f"The inputs that failed, with the verdict: {asked.out}/")
    return 1 if failed else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    parser.add_argument("--case", default="", help="Only this one, e.g. logs-17.")
    for kind, size in SIZES.items():
        parser.add_argument(f"--{kind}", type=int, default=size)
    asked = parser.parse_args()
    asked.cases = [(kind, n) for kind in KINDS for n in range(getattr(asked, kind))]
    if asked.case:
        kind, number = asked.case.split("-")
        asked.cases = [(kind, int(number))]
    asked.kinds = {kind for kind, _ in asked.cases}
    return asked


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _warm(seeds: Seeds, scratch: Path, kinds: set[str]) -> float:
    """Import and load what the commands need, once, before any fork.

    Processor time, s, that `quick` takes of a sound table with that; 0 where no kind asks for it.
    """
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)
    at = seeds.folder
    log, table_, project = str(at / "log.blf"), str(at / "table.parquet"), str(at / "log.toml")
    call(["replay", log, "-p", project, "--json"])
    call(["check", project, log, "--json"])
    if kinds & {"projects"}:
        call(["compare", log, "-p", project, "--json"])
        call(["export", log, str(scratch / "map.json"), "-p", project])
        call(["excite", "-p", str(at / "cylinder.toml"), str(scratch / "motion.csv"), "--json"])
    if kinds & {"projects", "tables"}:
        call(["diagnose", table_, "-p", str(at / "table.toml"), "--json"])
    begin_s = end_s = time.process_time()
    if kinds & {"dbcs", "nodes", "logs", "tables", "bombs"}:
        call(["quick", table_, "--json"])
        end_s = time.process_time()
        call(["init", str(at / "machine.dbc"), "-o", str(scratch / "new.toml")])
    if kinds & {"plants", "tables"}:
        for name in seeds.plants:
            call(["refit", str(at / f"{name}.toml"), str(at / f"{name}.csv"), "--json"])
    return end_s - begin_s


def _run(
    seeds: Seeds, asked: argparse.Namespace, scratch: Path, slower: float
) -> Iterator[Verdict]:
    """All verdicts; as many cases at once as there are workers.  slower: see `Running`."""
    waiting, done = list(reversed(asked.cases)), 0
    running: list[Running] = []
    while waiting or running:
        while waiting and len(running) < asked.workers:
            kind, number = waiting.pop()
            running.append(_started(seeds, asked.seed, kind, number, scratch, slower))
        for one in list(running):
            verdict = one.poll()
            if verdict is None:
                continue
            running.remove(one)
            if verdict.defect:
                one.keep(verdict, asked.out)
            shutil.rmtree(one.folder, ignore_errors=True)
            yield verdict
            done += 1
            if sys.stderr.isatty() or done % 100 == 0:
                print(f"{done} of {len(asked.cases)}", file=sys.stderr, flush=True)
        time.sleep(0.002)


def _started(
    seeds: Seeds, seed: int, kind: str, number: int, scratch: Path, slower: float
) -> Running:
    def work(folder: Path) -> dict[str, object]:
        case: Case = make(seeds, seed, kind, number, folder)
        outcome = call(case.arguments)
        defect, detail = judge(case, outcome, seeds)
        shown = [a.replace(f"{folder}/", "") for a in case.arguments]
        return {
            "defect": defect, "detail": detail, "code": outcome.code, "arguments": shown
        }  # fmt: skip

    name = f"{kind}-{number}"
    return Running(name, scratch / name, slower).start(work)


def table(verdicts: Sequence[Verdict]) -> str:
    """Cases, exit codes, defects, and the worst of processor time and memory, by kind."""
    codes = (0, 2, 3, 4)
    heads = ["kind", "cases", *(f"exit {c}" for c in codes), *DEFECTS, "most s", "most MB"]
    rows = [heads]
    for kind in (*KINDS, "all"):
        of = [v for v in verdicts if kind == "all" or v.name.startswith(kind)]
        if not of:
            continue
        ended, wrong = Counter(v.code for v in of), Counter(v.defect for v in of)
        numbers = [len(of), *(ended[c] for c in codes), *(wrong[d] for d in DEFECTS)]
        worst = [f"{max(v.cpu_s for v in of):.1f}", f"{max(v.peak_mb for v in of):.0f}"]
        rows.append([kind, *map(str, numbers), *worst])
    widths = [max(len(row[k]) for row in rows) for k in range(len(heads))]
    return "\n".join(
        "  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows
    )


def groups(failed: Sequence[Verdict]) -> list[str]:
    """One line per kind of failure, the most frequent first, with the first cases."""
    found: dict[str, list[str]] = {}
    for verdict in failed:
        found.setdefault(_signature(verdict), []).append(verdict.name)
    ordered = sorted(found.items(), key=lambda item: -len(item[1]))
    return [f"{len(names):4} {what}  ({', '.join(names[:4])})" for what, names in ordered]


def _signature(verdict: Verdict) -> str:
    """Kind of failure, last line of its detail, and where in our own code it was raised."""
    last = (verdict.detail.strip().splitlines() or [""])[-1][:160]
    frames = re.findall(r'File "[^"]*/((?:rtid|firmware_bridge)/[^"]+", line \d+)', verdict.detail)
    return " | ".join([verdict.defect, last, *frames[-1:]])


if __name__ == "__main__":
    sys.exit(main())
