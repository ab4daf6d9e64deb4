"""Every value that the comments of cylinder.toml offer works through `replay` and `export`."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

import rtid.project
from rtid.cli.main import build
from rtid.maps.files import read_map
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.replays import shared_replays  # noqa: F401

EXAMPLE = Path(rtid.project.__file__).parent / "examples" / "cylinder.toml"
TEXT = EXAMPLE.read_text("utf-8").replace('"p_A"', '"p_a"').replace('"p_B"', '"p_b"')
SAMPLES = 1000
TABLE = TEXT.replace('dbc = "builtin:controller.dbc"', "")


def changed(old: str, new: str, text: str = TEXT) -> str:
    """The text with another line in place of one that must be there."""
    assert re.search(f"(?m)^{old}", text), old
    return re.sub(f"(?m)^{old}", new, text)


# What a comment offers in place of what stands there.
OFFERED = {
    **{word: changed(r'# terms = "both"', f'terms = "{word}"') for word in ("both", "drop")},
    "command": changed(r'# terms = "both"', 'terms = "command"'),
    **{
        word: changed(r'# basis = "taylor"', f'basis = "{word}"')
        for word in ("taylor", "blended", "lapped")
    },
    **{
        word: changed(r'form = "integral"', f'form = "{word}"')
        for word in ("integral", "carry", "restart")
    },
    **{
        word: changed(r'mode = "cycle"', f'mode = "{word}"') for word in ("cycle", "multirate")
    },
    "estimate": changed(r"noise = .*$", 'noise = "estimate"'),
    "the age of a message": changed(
        r"(\[messages.Pressures\]\n.*\n)offset_ms = 0",
        r'\1tolerance_ms = 1\noffset_ms = "estimate"',
    ),
    "diameters": changed(
        r"area_cm2 = 9.*$", "piston_diameter_mm = 50\nrod_diameter_mm = 36",
        changed(r"area_cm2 = 19.*$", "piston_diameter_mm = 50"),
    ),
    "no tank pressure": changed(
        r'(\[signals.p_tank\].*\n)message.*\nsignal.*\ncolumn.*\n', r"\1constant = 1e5\n"
    ),
    "upkeep": changed(
        r"# (\w*forget_s|innovation_sd|folds) = ", r"\1 = ", changed("every_s = 0", "every_s = 1")
    ),
    "recent blocks": changed("recent_blocks = 64", "recent_blocks = 8"),
    "effect": changed(r"# (\[effects.worn_seal\]|(flow|unit|chambers|sign|largest|x0) = )", r"\1"),
    "publish": changed(
        r"# (\[publish\]|(\w+_id|\w+_percent|least_\w+|judge_s|frames_per_s|status) = )",
        r"\1", changed(r"# error_percent = 10 .*$", ""),
    ),
}  # fmt: skip
PRESSURES = {"Pa": 1.0, "kPa": 1e3, "bar": 1e5, "MPa": 1e6, "psi": 6894.757293168361}
COMMANDS = {"V": "v", "A": "a", "%": "pct"}


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = simulate(SimulatedPlant(), "rich", 0, 1e-3 * SAMPLES)
    folder = tmp_path_factory.mktemp("offered")
    write_run(folder / "table.parquet", run, 0, "rich")
    return write_run(folder / "run.blf", run, 0, "rich")[0]


def called(*arguments: str) -> str:
    """What `rtid ARGUMENTS` prints; it must not fail."""
    done = CliRunner().invoke(build(arguments), list(arguments))
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout


@pytest.mark.first_of(4)
@pytest.mark.parametrize("offered", OFFERED)
def test_what_a_comment_offers_works_through_replay_and_export(
    offered: str, trace: Path, tmp_path: Path
) -> None:
    project, snapshot = tmp_path / "machine.toml", tmp_path / "learned.npz"
    project.write_text(OFFERED[offered], "utf-8")
    told = json.loads(
        called("replay", str(trace), "-p", str(project), "--snapshot", str(snapshot), "--json")
    )
    assert told["samples"] == SAMPLES
    sources = (snapshot, trace) if offered in ("command", "estimate") else (snapshot,)
    for source in sources:
        written = json.loads(
            called("export", str(source), str(tmp_path / "map.json"), "-p", str(project), "--json")
        )
        assert set(written["valid_blocks"]) == {"pa", "at", "pb", "bt"}


DROPS = {"one interval": "[-8.0, 8.0]", "two": "[-1.0, 1.0, 8.0]"}


@pytest.mark.parametrize("terms", ["both", "drop", "command"])
@pytest.mark.parametrize("drops", DROPS)
def test_a_block_astride_no_pressure_drop_is_published(
    terms: str, drops: str, trace: Path, tmp_path: Path
) -> None:
    """The odd orifice law knew the even terms of such a block without error: LinAlgError."""
    text = changed(r'# terms = "both"', f'terms = "{terms}"')
    project = tmp_path / "machine.toml"
    project.write_text(
        changed(r"dp_grid_mpa = .*$", f"dp_grid_mpa = {DROPS[drops]}", text), "utf-8"
    )
    target = tmp_path / "map.json"
    called("export", str(trace), str(target), "-p", str(project), "--force")
    flowmap = read_map(target)[0]
    dp_pa = np.array([1e6, 3e6])
    flow = flowmap.flow("pa", 4.0, dp_pa)
    assert np.isfinite(flow).all() and np.isfinite(flowmap.sd("pa", 4.0, dp_pa)).all()
    if (terms, drops) == ("command", "one interval"):
        assert flow[0] == flow[1]  # a function of the command alone, as declared


def test_no_quoted_word_of_a_comment_is_left_out() -> None:
    """A new offer belongs into OFFERED."""
    offers = re.findall(r'(?m)^# (?:terms|basis) = .*$|^(?:form|mode) = .*$|"estimate"', TEXT)
    words = {word for line in offers for word in re.findall(r'"(\w+)"', line)}
    assert words == {
        *("both", "drop", "command", "taylor", "blended", "lapped"),
        *("integral", "carry", "restart", "cycle", "multirate", "estimate"),
    }
    assert words <= set(OFFERED)


def units_table(run: Path, folder: Path, pressure: str) -> Path:
    """The samples of the trace as CSV, with pressures in another unit."""
    table = pyarrow.parquet.read_table(run.with_name("table.parquet"))
    columns = {name: table[name].to_numpy() for name in table.column_names}
    for name in ("p_a", "p_b", "p_supply", "p_tank"):
        columns[name] = columns[name] / PRESSURES[pressure]
    path = folder / "run.csv"
    pyarrow.csv.write_csv(pa.table({k: pa.array(np.asarray(c)) for k, c in columns.items()}), path)
    return path


@pytest.mark.parametrize("unit", PRESSURES)
def test_a_pressure_may_have_any_unit_that_is_offered(
    unit: str, trace: Path, tmp_path: Path
) -> None:
    text = TABLE.replace('unit = "Pa"', f'unit = "{unit}"')
    for noise in ("5e3", "1e3"):
        text = text.replace(f"noise = {noise}", f"noise = {float(noise) / PRESSURES[unit]!r}")
    project = tmp_path / "machine.toml"
    project.write_text(re.sub(r"(?m)^(message|signal) = .*\n", "", text), "utf-8")
    table = units_table(trace, tmp_path, unit)
    told = json.loads(called("replay", str(table), "-p", str(project), "--json"))
    assert told["beta_pa"]["a"] == pytest.approx(850e6, rel=0.2)


@pytest.mark.parametrize("unit", COMMANDS)
def test_a_command_may_have_any_unit_that_is_offered(
    unit: str, trace: Path, tmp_path: Path
) -> None:
    text = TABLE.replace('unit = "V"', f'unit = "{unit}"')
    text = re.sub(r"(?m)^(u_grid|safe_band)_v", rf"\1_{COMMANDS[unit]}", text)
    project = tmp_path / "machine.toml"
    project.write_text(re.sub(r"(?m)^(message|signal) = .*\n", "", text), "utf-8")
    table = units_table(trace, tmp_path, "Pa")
    told = json.loads(called("replay", str(table), "-p", str(project), "--json"))
    assert told["beta_pa"]["a"] == pytest.approx(850e6, rel=0.2)
