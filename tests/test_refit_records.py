"""`rtid refit` on records with gaps, and on effects that do not help where nobody has fitted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rtid.cli.exits import Exit
from rtid.plain import FloatArray
from tests.command import called
from tests.test_names import PLANT

STEP_S, A, B, NOISE = 0.02, 2.0, 3.0, 0.02
VALIDATED = PLANT.replace('"t_ms"', '"t"') + "[validation]\nfrom_s = 24.0\n"


def steps_of_input(seed: int, n: int) -> FloatArray:
    """Steps of random height, each 0.8 s long."""
    levels = np.random.default_rng(seed).uniform(-1, 1, n // 40 + 1)
    return np.repeat(levels, 40)[:n]


def lagged(u: FloatArray, x0: float = 0.0) -> FloatArray:
    """x' = b u - a x at held inputs, with the sensor's noise."""
    x, decay = np.full(len(u), x0), np.exp(-A * STEP_S)
    for k in range(len(u) - 1):
        x[k + 1] = decay * x[k] + B / A * u[k] * (1 - decay)
    return np.asarray(x + NOISE * np.random.default_rng(9).standard_normal(len(u)))


def table(path: Path, **columns: FloatArray) -> Path:
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, fmt="%.6f", delimiter=",", header=",".join(columns), comments="")
    return path


def plant(tmp_path: Path, text: str) -> Path:
    (path := tmp_path / "lag.toml").write_text(text.replace('"x [mm]"', '"x"'))
    return path


def test_a_free_run_begins_anew_behind_a_gap(tmp_path: Path) -> None:
    """Nobody recorded what moved the machine in a pause of 21 s; once it was integrated through."""
    u = steps_of_input(1, 1200)
    x = np.concatenate([lagged(u[:600]), lagged(u[600:], x0=25.0)])
    t: FloatArray = STEP_S * np.arange(1200, dtype=np.float64)
    t = t + np.where(t < 600 * STEP_S - 1e-9, 0.0, 21.0)
    t = np.append(t, 100.0)  # a last row that stands alone
    path = table(tmp_path / "gap.csv", t=t, u=np.append(u, 0.0), x=np.append(x, 25.0))
    text = PLANT.replace('"t_ms"', '"t"')
    done = called("refit", plant(tmp_path, text), path)
    assert "has gaps (21 s from 11.98 s on)" in done.stdout
    assert "begins anew behind each, in 2 pieces" in " ".join(done.stdout.split())
    assert "Left out: 100 to 100 s, fewer than 20 rows beside a gap" in done.stdout
    told = json.loads(called("refit", plant(tmp_path, text), path, "--json").stdout)
    values = {p["name"]: p["value"] for p in told["parameters"]}
    assert values["a"] == pytest.approx(A, rel=0.02)
    assert values["x(0) of part 2"] == pytest.approx(25.0, abs=0.1)
    assert told["rmse_after"]["identification"]["y"] == pytest.approx(NOISE, rel=0.1)
    assert told["parts"]["identification"] == [
        {"from_s": 0.0, "to_s": 11.98}, {"from_s": 33.0, "to_s": 44.98}
    ]  # fmt: skip
    validated = json.loads(
        called("refit", plant(tmp_path, VALIDATED.replace("24.0", "10.0")), path, "--json").stdout
    )
    assert len(validated["parts"]["validation"]) == 2
    assert validated["rmse_after"]["validation"]["y"] == pytest.approx(NOISE, rel=0.15)


def test_what_does_not_help_on_unseen_data_is_not_named(tmp_path: Path) -> None:
    """The input came 0.3 s late in the identification part alone: what is so is none of a plant."""
    late, split, n = 15, 700, 1100
    u = steps_of_input(2, n)
    acts = u.copy()
    acts[late:split] = u[: split - late]
    path = table(
        tmp_path / "late.csv", t=STEP_S * np.arange(n, dtype=np.float64), u=u, x=lagged(acts)
    )
    text = VALIDATED.replace("24.0", f"{STEP_S * split}")
    done = called("refit", plant(tmp_path, text), path, "--diagnose", "--json")
    assert done.returncode == Exit.OK, done.stderr
    told = json.loads(done.stdout)
    assert (told["verdict"], told["found"]) == ("unknown", [])
    (refuted,) = told["refuted"]
    assert (refuted["effect"], refuted["where"]) == ("pure_delay", "u")
    assert refuted["validation_rmse_with"][0] > 1.1 * refuted["validation_rmse_without"][0]
