"""One trace of a fleet: what it tells, as one row, and its sums; what fails is told in the row.

Sums are those of nominal weights, as on board, so that traces of one declaration add up.
"""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import INSUFFICIENT
from rtid.diagnosing import diagnose_trace
from rtid.estimator.estimator import Estimator
from rtid.estimator.sums import Sums
from rtid.fleet.jobs import Job
from rtid.project import Project, load
from rtid.replay import NoSamplesError, model_for, read_trace
from rtid.store import FOLD

OURS = ("rtid", "firmware_bridge")  # their own error classes are meant for the user


@dataclass(frozen=True)
class Outcome:
    """A row of the results, and the sums of the trace as bytes (empty where there are none)."""

    job: Job
    row: dict[str, Any]
    sums: bytes = field(default=b"", repr=False)


def outcome(job: Job, with_diagnosis: bool) -> Outcome:
    """Learn from one trace and diagnose it; never raises: a defect is a row, too."""
    start_s = time.process_time()
    row, sums = empty_row(job), b""
    try:
        project = _project(job.project, job.project.stat().st_mtime_ns)
        learned, found = _learned(project, job.trace)
        row, sums = row | found, packed(learned)
        if with_diagnosis:
            row |= _verdict(project, job.trace)
    except Exception as error:  # one trace must not stop the rest
        row |= _told(error)
    row["cpu_s"] = time.process_time() - start_s
    return Outcome(job, row, sums)


def _told(error: Exception) -> dict[str, str]:
    """An error in words: those that are meant for the user as they are, others as a defect."""
    if isinstance(error, OSError) or type(error).__module__.split(".")[0] in OURS:
        return {"error": str(error), "remedy": getattr(error, "remedy", "")}
    return {"error": f"{type(error).__name__}: {error}", "remedy": "a defect: please report it"}


def empty_row(job: Job) -> dict[str, Any]:
    """A row that knows of its job alone."""
    return {
        "key": job.key, "trace": str(job.trace), "machine": job.machine, "digest": "",
        "start_us": 0, "duration_s": 0.0, "rows": 0, "rho": float("nan"), "beta_pa": [],
        "beta_sd_pa": [], "verdict": "", "effects": [], "places": [], "sizes": [], "units": [],
        "heldout_before_pct": float("nan"), "heldout_after_pct": float("nan"), "truncated": False,
        "cpu_s": 0.0, "error": "", "remedy": "",
    }  # fmt: skip


@lru_cache(maxsize=64)
def _project(path: Path, _changed_ns: int) -> Project:
    return load(path)


def _learned(project: Project, path: Path) -> tuple[Sums, dict[str, Any]]:
    trace = read_trace(project, path)
    estimator = Estimator(model_for(project, trace.samples))
    estimator.update(trace.samples)
    solution = estimator.solution()
    return estimator.sums, {
        "digest": project.digest,
        "start_us": int(trace.samples.t_us[0]),
        "duration_s": trace.duration_s,
        "rows": int(solution.counters.get("rows", 0)),
        "rho": float(solution.rho),
        "beta_pa": solution.beta_pa.tolist(),
        "beta_sd_pa": solution.beta_sd_pa.tolist(),
        "truncated": bool(trace.counters.get("truncated", 0)),
    }


def _verdict(project: Project, path: Path) -> dict[str, Any]:
    """What a diagnosis says; one that is too short for it has been learned from all the same."""
    try:
        return _diagnosed(diagnose_trace(project, path).diagnosis)
    except NoSamplesError as error:
        return {"verdict": INSUFFICIENT, "remedy": str(error)}


def _diagnosed(told: Diagnosis) -> dict[str, Any]:
    sizes = [next(iter(effect.parameters.values())) for effect in told.found]
    percent = 100.0 / max(told.rms_flow_m3s, 1e-12)
    return {
        "verdict": told.verdict,
        "effects": [effect.effect for effect in told.found],
        "places": [effect.where for effect in told.found],
        "sizes": [float(size.value) for size in sizes],
        "units": [size.unit for size in sizes],
        "heldout_before_pct": percent * told.heldout_residual_before_m3s,
        "heldout_after_pct": percent * told.heldout_residual_after_m3s,
    }


def packed(sums: Sums) -> bytes:
    """Sums as the bytes of an npz file."""
    memory = io.BytesIO()
    arrays: Mapping[str, Any] = {name: getattr(sums, name) for name in FOLD}
    np.savez_compressed(memory, **arrays)
    return memory.getvalue()


def unpacked(content: bytes) -> Sums:
    """The sums that were packed."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        parts = {name: file[name] for name in FOLD}
    return Sums(**parts | {"rows": float(parts["rows"])})
