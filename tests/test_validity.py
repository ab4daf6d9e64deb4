"""What is impossible is said to be invalid, and leaves the program only by force."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.cli.exits import Exit
from rtid.estimator.validity import doubts, doubts_of_lag
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.command import ends, in_json
from tests.diagnose.records import record
from tests.replays import shared_replays  # noqa: F401


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound record of 850 MPa, whose project allows 100 to 400 MPa."""
    trace = tmp_path_factory.mktemp("valid") / "run.parquet"
    write_run(trace, simulate(SimulatedPlant(), "rich", 0, 30.0), 0, "rich")
    project = trace.with_suffix(".toml")
    text = re.sub(r"(?m)^bounds_mpa = .*$", "bounds_mpa = [100.0, 400.0]", project.read_text())
    project.write_text(re.sub(r"(?m)^nominal_mpa = .*$", "nominal_mpa = 300.0", text))
    return trace


def test_an_impossible_modulus_is_invalid_everywhere(
    narrow: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    project = narrow.with_suffix(".toml")
    doubts = in_json("replay", narrow, "-p", project, code=Exit.NEGATIVE)["doubts"]
    invalid = [doubt["what"] for doubt in doubts if doubt["is_invalid"]]
    assert invalid == ["beta_a", "beta_b"]
    out = tmp_path / "map.csv"
    assert ends("export", narrow, out, "-p", project) == Exit.NEGATIVE
    told = capsys.readouterr().err
    assert "outside the declared 100 to 400 MPa" in " ".join(told.split()) and "--force" in told
    assert not out.exists()
    assert ends("export", narrow, out, "-p", project, "--force") == Exit.OK and out.exists()
    capsys.readouterr()
    diagnosed = in_json("diagnose", narrow, "-p", project, code=Exit.NEGATIVE)
    assert diagnosed["verdict"] != "matches" and diagnosed["doubts"][0]["is_invalid"]


def test_moduli_that_contradict_each_other_are_said_to() -> None:
    model = replace(record()[0], beta_bounds_pa=(200e6, 1600e6))
    beta = np.array([635e6, 657e6])
    sd = 0.4e6 / beta**2
    (doubt,) = doubts(model, 1.0 / beta, np.diag(sd**2))
    assert not doubt.is_invalid and "contradict each other by 2" in doubt.reason
    assert all(word in doubt.remedy for word in ("area ratio", "wall", "hose"))
    assert doubts(model, 1.0 / beta, np.diag((20 * sd) ** 2)) == ()


@pytest.mark.parametrize(
    ("lag_ms", "sd_ms", "count"),
    [(0.02, 0.005, 1), (0.02, 0.05, 0), (1.3, 0.01, 0), (0.0, 0.0, 0), (900.0, 1.0, 1)],
)
def test_a_lag_that_no_valve_has_is_invalid(lag_ms: float, sd_ms: float, count: int) -> None:
    assert len(doubts_of_lag(1e-3 * lag_ms, 1e-3 * sd_ms)) == count
