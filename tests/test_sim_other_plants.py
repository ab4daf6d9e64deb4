"""The worked examples that are no hydraulic machine: what is hidden in them is found and added."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtid.cli.exits import Exit
from rtid.errors import RtidError
from rtid.project.plant_file import load_plant
from rtid.sim.other_plants import EXAMPLES, write_example
from rtid.study.refit import Refitted, load_records, run
from tests.command import ends, in_json


def refitted(folder: Path, name: str, hide: bool, diagnose: bool) -> Refitted:
    _, (table, plant) = write_example(name, folder / f"{name}.csv", 1, hide)
    file = load_plant(plant)
    return run(file, load_records(file, table), with_diagnosis=diagnose)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_equations_are_enough_where_nothing_is_hidden(name: str, tmp_path: Path) -> None:
    """The free run ends at the sensor's noise, on the part that was kept away too."""
    errors = refitted(tmp_path, name, False, False)
    noise = {"electric_drive": 0.1, "heated_room": 0.02}[name]
    for part in errors.errors(errors.last).values():
        assert part[0] == pytest.approx(noise, rel=0.1)


@pytest.mark.long
@pytest.mark.hidden_effect
@pytest.mark.parametrize("name", EXAMPLES)
def test_what_is_hidden_is_found_and_the_error_falls(name: str, tmp_path: Path) -> None:
    told, _ = write_example(name, tmp_path / "truth.csv", 1, True)
    found = refitted(tmp_path, name, True, True)
    assert found.diagnosis is not None
    assert [":".join(f.key) for f in found.diagnosis.found] == [told.hidden]
    before, after = (found.errors(m)["validation"][0] for m in (found.first, found.last))
    noise = {"electric_drive": 0.1, "heated_room": 0.02}[name]
    assert before > 3 * noise and after < 1.15 * noise


def test_the_record_is_written_with_its_plant_file(tmp_path: Path) -> None:
    table = tmp_path / "drive.csv"
    told = in_json("simulate", table, "--example", "electric_drive")
    assert told["hidden"][0]["effect"] == "coulomb_friction:w"
    assert told["files"] == [str(table), str(table.with_suffix(".toml"))]
    assert np.loadtxt(table, delimiter=",", skiprows=1).shape == (800, 3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["drive.csv", "--example", "submarine"], "electric_drive, heated_room"),
        (["drive.blf", "--example", "heated_room"], ".csv"),
        (["--example", "heated_room"], "name a .csv file"),
        (["room.csv", "--example", "heated_room", "--hide", "backlash"], "--hide none"),
    ],
)
def test_what_cannot_be_written_is_refused(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert ends("simulate", *arguments) == Exit.USAGE
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_unknown_example_names_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(RtidError, match="submarine"):
        write_example("submarine", tmp_path / "x.csv", 0, True)
