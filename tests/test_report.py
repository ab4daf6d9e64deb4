"""`rtid report`: one file with the verdict, the pictures and the tables; it loads nothing."""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from rtid.diagnose.residual import Residual
from rtid.errors import RtidError
from rtid.project import load
from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.study.revisions import add
from rtid.study.spans import added_parts
from rtid.tell.diagnosed import LIMITS_SAY, limits, sentences
from rtid.tell.report import page, stills
from rtid.tell.report_file import Reported, report
from rtid.tell.report_story import ReportStory
from tests.command import in_json
from tests.replays import shared_replays  # noqa: F401

SEED, DURATION_S = 3, 30.0
MOST_BYTES = 3_000_000
LOADS = ("src", "href", "data", "poster", "srcset", "action", "background", "xlink:href")


def recorded(folder: Path, wish: str) -> tuple[Path, Path]:
    """Trace and project of a random machine, with a hidden effect or none."""
    machine = hide_wish(draw(SEED), wish) if wish else draw(SEED)
    trace, _, project = write_run(
        folder / "run.parquet", simulate(machine, "rich", SEED, DURATION_S), SEED, "rich"
    )
    return trace, project


@pytest.fixture(scope="module")
def leaking(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    folder = tmp_path_factory.mktemp("leaking")
    trace, project = recorded(folder, "internal_leakage_laminar=strong")
    return report(load(project), trace, folder / "report.html")


class Reader(HTMLParser):
    """Everything that a browser would fetch, and the words that it would show."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loaded += [value or "" for name, value in attrs if name in LOADS]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def read(path: Path) -> tuple[Reader, str]:
    """A page, and its words with single blanks."""
    reader = Reader()
    reader.feed(path.read_text("utf-8"))
    reader.close()
    return reader, " ".join("".join(reader.words).split())


def test_the_file_is_small_and_loads_nothing(leaking: Reported) -> None:
    reader, _ = read(leaking.path)
    assert leaking.size == leaking.path.stat().st_size <= MOST_BYTES
    assert not {"link", "iframe", "object", "embed", "base", "img"} & set(reader.tags)
    assert reader.loaded == []  # scripts are part of the file
    own = re.sub(r"(?s)<script.*?</script>", "", leaking.path.read_text("utf-8"))
    assert not re.search(r"https?://|@import|url\(", own)


def test_the_verdict_stands_in_plain_sentences(leaking: Reported) -> None:
    _, words = read(leaking.path)
    found = leaking.told.diagnosed.diagnosis
    assert found.verdict == "missing"
    for sentence in sentences(found):
        assert " ".join(sentence.split()) in words
    assert "Internal leakage, laminar at a-b" in words


def test_the_error_after_is_below_the_error_before(leaking: Reported) -> None:
    told = leaking.told
    assert told.after is not None
    assert told.after[1].rms_m3s < 0.2 * told.before[1].rms_m3s
    before, after = (part[told.judges].rms_m3s for part in (told.before, told.after))
    assert after < 0.2 * before
    found = leaking.told.diagnosed.diagnosis
    assert before == pytest.approx(found.heldout_residual_before_m3s, rel=1e-9)
    assert after == pytest.approx(found.heldout_residual_after_m3s, rel=1e-9)
    _, words = read(leaking.path)
    shares = [100 * r / found.rms_flow_m3s for r in (before, after)]
    assert f"{shares[0]:.2f} % → {shares[1]:.2f} %" in words
    assert ("errors are of the identification part" in words) == (told.judges == 0)


def test_what_was_found_leads_the_ranking(leaking: Reported) -> None:
    first, *others = leaking.told.ranking
    assert first.key == ("internal_leakage_laminar", "a-b")
    assert first.after is None
    assert first.before is not None
    assert first.before > max(r.before or 0.0 for r in others)
    assert first.before > 100
    fell = [r for r in others if r.before and r.after is not None and r.after < 0.5 * r.before]
    assert len(fell) > len(others) / 2  # the imitators fall once the cause is part of the model
    assert "Each coefficient is what is left of it once what was found" in read(leaking.path)[1]


def test_every_picture_has_a_sentence_below(leaking: Reported) -> None:
    text = leaking.path.read_text("utf-8")
    captions = re.findall(r"(?s)<figure>.+?<figcaption>(.+?)</figcaption></figure>", text)
    _, words = read(leaking.path)
    assert len(captions) == 7
    assert text.count("data-root-id=") == 5  # drawn by Bokeh; the other two are HTML
    assert all(unescape(c).strip().endswith(".") for c in captions)
    for heading in ("not found", "cannot show", "Coverage", "Parameters", "Where this comes from"):
        assert heading in words
    assert "Present but negligible" not in words  # there is nothing


def test_coverage_and_parameters_are_those_of_the_fit(leaking: Reported) -> None:
    told = leaking.told
    _, words = read(leaking.path)
    for edge in told.flowmap.edges:
        known = int((edge.status == "valid").sum())
        assert f"{edge.name}{known} of {edge.status.size}" in words.replace(
            f"{edge.name} ", edge.name
        )
        assert len(told.points[edge.name]) > 20
    said = told.diagnosed.diagnosis
    beta, sd = said.beta_pa[0], said.beta_sd_pa[0]
    assert 0.0 < sd < 0.01 * beta
    assert f"bulk modulus, chamber a{1e-6 * beta:.0f} ± {1.96e-6 * sd:.1f} MPa" in words


def test_it_says_where_it_comes_from(leaking: Reported) -> None:
    _, words = read(leaking.path)
    told = leaking.told
    trace = told.diagnosed.trace.path
    assert hashlib.sha256(trace.read_bytes()).hexdigest() in words
    assert told.diagnosed.project.digest in words
    assert trace.name in words
    assert "History" not in words


def test_every_effect_not_found_is_listed_once(leaking: Reported) -> None:
    reader, words = read(leaking.path)
    unseen = leaking.told.diagnosed.diagnosis.not_found
    rows = reader.tags.count("tr")
    assert rows > len(unseen)
    assert all(u.reason in words for u in unseen if not u.visible)
    assert LIMITS_SAY in words
    assert all(size in words for u in unseen if u.visible for size in limits(u))


@pytest.mark.long
def test_a_model_that_matches_and_its_history(tmp_path: Path, leaking: Reported) -> None:
    trace, project = recorded(tmp_path, "")
    before = leaking.told.diagnosed.trace.path
    add(project, before, "internal_leakage_laminar", "a-b", reason="<worn> seal & more")
    assert added_parts(load(project))
    told = in_json("report", trace, "-p", project, "-o", tmp_path / "r.html")
    _, words = read(tmp_path / "r.html")
    assert told["verdict"] == "matches"
    assert told["bytes"] == (tmp_path / "r.html").stat().st_size
    assert "The model matches" in words
    assert "with what was found" not in words
    assert "History of the model" in words
    assert "<worn> seal & more" in words


@pytest.mark.parametrize("name", ["absent/report.html", ".", "run.parquet", "run.toml"])
def test_a_place_that_cannot_be_written_is_refused_at_once(leaking: Reported, name: str) -> None:
    told = leaking.told.diagnosed
    content = told.trace.path.read_bytes()

    def never(_what: str, _share: float) -> None:
        raise AssertionError("the work has begun")

    with pytest.raises(RtidError, match=r"no such folder|is a folder|is made from") as refusal:
        report(told.project, told.trace.path, told.trace.path.parent / name, never)
    assert refusal.value.remedy
    assert told.trace.path.read_bytes() == content


def test_a_disk_that_refuses_leaves_no_half_file(
    leaking: Reported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(*_arguments: object) -> ReportStory:
        return leaking.told

    def refuse(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rtid.tell.report_file.tell", told)
    monkeypatch.setattr("rtid.tell.report_file.page", lambda _story: "drawn elsewhere")
    monkeypatch.setattr("rtid.tell.report_file.os.replace", refuse)
    found = leaking.told.diagnosed
    with pytest.raises(RtidError, match="No space left"):
        report(found.project, found.trace.path, tmp_path / "report.html")
    assert not list(tmp_path.iterdir())


def test_a_record_of_which_nothing_could_be_judged_has_a_page_too(leaking: Reported) -> None:
    told, none = leaking.told, np.empty((0, 2))
    empty, nan = Residual(np.empty(0), none, none, none), float("nan")
    found = replace(
        told.diagnosed.diagnosis,
        verdict="insufficient_data",
        found=(),
        rho_before=1.0,
        rho_after=1.0,
        heldout_residual_before_m3s=nan,
        heldout_residual_after_m3s=nan,
        noise_floor_m3s=nan,
    )
    bare = replace(
        told,
        diagnosed=replace(told.diagnosed, diagnosis=found),
        before=(empty, empty),
        after=None,
        depends_before=(),
        depends_after=(),
        ranking=(),
        evidence=(),
    )
    reader = Reader()
    reader.feed(page(bare))
    words = "".join(reader.words)
    assert "This record cannot tell." in words
    assert "No flow of this record could be judged." in words
    assert "nan" not in words.split()


def test_a_floor_of_nothing_is_no_floor(leaking: Reported) -> None:
    """Where one disturbance stands for all that the command does not say, no sensor has a part."""
    told = leaking.told
    found = replace(told.diagnosed.diagnosis, noise_floor_m3s=0.0)
    story = replace(told, diagnosed=replace(told.diagnosed, diagnosis=found))
    reader = Reader()
    reader.feed(page(story))
    words = " ".join(reader.words)
    assert "0.00 %" not in words and "sensors' floor" not in words and "not known" in words
    assert not stills(story)["errors"].axes[0].get_lines()


@pytest.mark.long
def test_the_same_story_gives_the_same_page(leaking: Reported) -> None:
    assert page(leaking.told) == leaking.path.read_text("utf-8")
