"""Run methods on records, one process per method: answers, scores, processor time, memory.

    python -m benchmarks.missing.collect FOLDER METHOD MOST     what a child of `__main__` does

A method is warmed up on a cut of the first record (compilers, caches), then every record's `learn`
and `predict` are timed by the process's own clock, on one thread.  Memory is the child's peak over
what it had with that record loaded (Linux: VmHWM, which a 5 in clear_refs sets back; ru_maxrss
begins at the parent's).  What was done is not done again: results are lines of JSON.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.missing.methods import FILES, methods_of
from benchmarks.missing.record import Case, Method, NotForThisError, Record
from benchmarks.missing.score import FAILED, Score, scored
from rtid.plain import plain

WARM = 8000  # samples
ORDER = "order.json"
MIB = 1024.0


def draw_seed(seed: int, name: str) -> int:
    """The number of a case's machine: nobody chooses it, and no case depends on the others."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:4], "big")


def path_of(folder: Path, name: str) -> Path:
    """Where a record lies."""
    return folder / "records" / (name.replace(" ", "_") + ".pickle")


def write_order(folder: Path, cases: list[Case]) -> None:
    """Records for all methods first, then the others as drawn by lot: a part is no selection."""
    stems = [(path_of(folder, case.name).stem, case.for_all) for case in cases]
    stems.sort(key=lambda at: (not at[1], hashlib.sha256(at[0].encode()).digest()))
    (folder / ORDER).write_text(json.dumps(stems))


def digest(case: Case) -> str:
    """What the record is sealed with."""
    whole = hashlib.sha256()
    for values in (case.train.t_s, case.train.values, case.test.values, case.truth.target):
        whole.update(values.tobytes())
    return whole.hexdigest()


def run_all(folder: Path, method: Method, most: int) -> Iterator[dict[str, Any]]:
    """Results of a method on the first `most` records of a folder that lack one, one by one."""
    warm = True
    done = {line["case"] for line in results(folder, method.name())}
    for stem, for_all in json.loads((folder / ORDER).read_text())[:most]:
        if stem in done or not (for_all or says_names(method)):
            continue
        path = folder / "records" / f"{stem}.pickle"
        case: Case = pickle.loads(path.read_bytes())
        try:
            if warm:
                _warm_up(method, case.train)
                warm = False
            before = _from_here_mib()
            line = {"case": path.stem, "method": method.name()} | one_case(case, method)
            yield line | {"memory_mib": _peak_mib() - before}
        except NotForThisError:
            continue


def says_names(method: Method) -> bool:
    """Whether its answers may hold names."""
    return bool(getattr(method, "says_names", False))


def _warm_up(method: Method, record: Record) -> None:
    cut = replace(record, t_s=record.t_s[:WARM], values=record.values[:WARM])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            method.learn(cut).predict(cut)
        except NotForThisError:
            raise
        except Exception as error:  # too short for it: it is only warmed up
            print(f"warm-up of {method.name()}: {error}", file=sys.stderr)


def one_case(case: Case, method: Method) -> dict[str, Any]:
    """Score and times in s of the processor; a method that fails is told so."""
    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            learned = method.learn(case.train)
            learn_s = time.process_time() - began
            score, failed = scored(case, learned), ""
    except NotForThisError:
        raise
    except Exception as error:  # one method's failure is a result, too
        learn_s, failed = time.process_time() - began, f"{type(error).__name__}: {error}"[:200]
        score = failed_score(method)
    times = {"learn_s": learn_s, "judge_s": time.process_time() - began - learn_s}
    return plain(asdict(score)) | times | {"failed": failed}


def failed_score(method: Method) -> Score:
    """A method that breaks off has predicted nothing and named nothing."""
    nan = float("nan")
    return Score(float("inf"), nan, nan, nan, nan, FAILED if says_names(method) else "", ())


def _peak_mib() -> float:
    """The largest resident memory since `_from_here_mib`, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / MIB


def _from_here_mib() -> float:
    """Begin the peak anew: what is resident now, MiB."""
    Path("/proc/self/clear_refs").write_text("5")
    return _peak_mib()


def file_of(folder: Path, method: str) -> Path:
    """Where a method's results are."""
    word = "".join(c if c.isalnum() else "_" for c in method)
    return folder / "results" / f"{word}.jsonl"


def results(folder: Path, method: str) -> list[dict[str, Any]]:
    """What is there of a method."""
    path = file_of(folder, method)
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def main(folder: Path, name: str, most: int) -> None:
    """One method on all records, its lines appended as they come."""
    method = methods_of(FILES)[name]
    path = file_of(folder, name)
    path.parent.mkdir(exist_ok=True)
    with path.open("a") as file, threadpool_limits(1):
        for line in run_all(folder, method, most):
            file.write(json.dumps(line) + "\n")
            file.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
