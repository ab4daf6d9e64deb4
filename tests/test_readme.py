"""README and the pages in docs/: their links lead somewhere, their commands and options exist."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from typer.core import TyperGroup
from typer.main import get_command

from benchmarks.table import replace_between
from rtid.cli.main import COMMANDS, build
from tests.campaign.report import MARKER

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", *(f"docs/{page.name}" for page in sorted((ROOT / "docs").glob("*.md"))))
WORD = re.compile(r"^(?:\$ )?(?:\.venv/bin/)?rtid (?=[a-z-])")
PLACEHOLDER = {"COMMAND"}


def text_of(page: str) -> str:
    return (ROOT / page).read_text()


def commands(text: str) -> Iterator[list[str]]:
    """The words behind `rtid` of every command line, in blocks and between backticks."""
    for block in re.findall(r"^```[\w ]*\n(.*?)^```", text, re.M | re.S):
        for line in block.replace("\\\n", " ").splitlines():
            if WORD.match(line):
                yield from _calls(re.split(r"\s{2,}#|\s#\s", line)[0])
    for code in re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)):
        if WORD.match(code):
            yield from _calls(code)


def _calls(line: str) -> Iterator[list[str]]:
    for call in re.split(r"&&|\||;", " ".join(line.split())):
        if WORD.match(call.strip()):
            yield shlex.split(WORD.sub("", call.strip()))


@cache
def options(command: str) -> set[str]:
    """All spellings of a command's options."""
    group = get_command(build([command]))
    assert isinstance(group, TyperGroup)
    found = group.commands[command]
    return {"--help", *(o for p in found.params for o in (*p.opts, *p.secondary_opts))}


@pytest.mark.parametrize("page", PAGES)
def test_commands_and_options_exist(page: str) -> None:
    found = list(commands(text_of(page)))
    for command, *words in found:
        if command in PLACEHOLDER or command.startswith("-"):
            continue
        assert command in COMMANDS, f"{page}: rtid {command}"
        told = {word.partition("=")[0] for word in words if re.match(r"-{1,2}[a-z]", word)}
        assert told <= options(command), f"{page}: rtid {command} {told - options(command)}"
    if page == "README.md":
        assert len(found) > 15


def anchors(page: Path) -> set[str]:
    """The names under which the headings of a page can be linked."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    here = ROOT / page
    for link in re.findall(r"\]\(([^)\s]+)\)", here.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = here.parent / path if path else here
        assert target.exists(), f"{page}: {link}"
        assert not anchor or anchor in anchors(target), f"{page}: {link}"


def test_readme_is_short() -> None:
    assert len(text_of("README.md").splitlines()) <= 160


def test_every_page_is_linked_from_readme() -> None:
    text = text_of("README.md")
    assert [page for page in PAGES[1:] if f"]({page}" not in text] == []


@pytest.mark.parametrize("marker", [MARKER, "speed"])
def test_generators_find_their_places(marker: str) -> None:
    text = text_of("docs/figures.md")
    written = replace_between(text, marker, "| new |")
    assert "| new |" in written and len(written) < len(text)


def test_pictures_are_made() -> None:
    """`make pictures` and `make paper` draw what README and the pages show."""
    shown = {Path(x).name for p in PAGES for x in re.findall(r"\]\((\S+\.png)\)", text_of(p))}
    assert shown == {path.name for path in (ROOT / "tools" / "pictures").glob("*.png")}
