"""The C of a controller against MISRA C:2012, as far as cppcheck's addon knows it.

    python -m tests.mcu.misra    the findings, and their table into docs/controller.md

A required rule may be broken only where a comment of that line, or of the two above it, says why:
`MISRA 21.15: the bits of a number`.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.table import replace_between
from rtid.mcu.c_tables import SOURCES, tables
from rtid.mcu.valve import one_valve
from rtid.mcu.write import TABLES
from tests.estimator.cases import draw_case

PAGE = Path(__file__).parents[2] / "docs/controller.md"
MANDATORY = {"9.1", "12.5", "13.6", "17.3", "17.4", "17.6", "19.1", "21.13", "21.17", "21.18"}
MANDATORY |= {"21.19", "21.20", "22.2", "22.4", "22.5", "22.6"}
ADVISORY = {
    "2.3": "unused type",
    "2.4": "unused tag",
    "2.5": "unused macro",
    "5.9": "internal names that two files share",
    "8.11": "the length of a version symbol",
    "8.7": "for users outside these files",
    "8.9": "constants of one function",
    "12.1": "precedence without parentheses",
    "12.3": "more than one declarator in a line",
    "15.5": "more than one return",
    "20.1": "an include behind the types that it is for",
}
ABOVE = 2  # lines
UNNAMED = re.compile(r"(enum|struct) \{")


@dataclass(frozen=True)
class Finding:
    """A place that breaks a rule; reason: what the code says for it, "" where nothing."""

    file: str
    line: int
    rule: str
    reason: str

    @property
    def required(self) -> bool:
        """Of a required rule."""
        return self.rule not in MANDATORY and self.rule not in ADVISORY


def check() -> list[Finding]:
    """All findings once, whatever number of sources include the header; every configuration."""
    case = draw_case(1, faults=0, terms=3)  # with shared terms, and two edges open at once
    with TemporaryDirectory() as name:
        folder = Path(shutil.copytree(SOURCES, Path(name) / "c"))  # cppcheck writes beside them
        (folder / TABLES).write_text(tables(one_valve(case.model, case.model.chambers[0].name)))
        command = ["cppcheck", "-q", "--std=c99", "--addon=misra", "--enable=style"]
        command += [f"-I{folder}", "--template={file}:{line}:{id}"]
        done = subprocess.run(
            [*command, *map(str, sorted(folder.glob("*.c")))],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        told = sorted(set(re.findall(r"(.+):(\d+):misra-c2012-([\d.]+)", done.stderr)))
        found = [_finding(Path(path), int(line), rule) for path, line, rule in told]
    return [f for f in found if f is not None]


def _finding(path: Path, line: int, rule: str) -> Finding | None:
    lines = path.read_text().splitlines()
    if rule == "5.7" and UNNAMED.search(lines[line - 1]):
        return None  # cppcheck 2.10 calls the first one without a tag Anonymous0 in every file
    beside = " ".join(lines[max(0, line - 1 - ABOVE) : line])
    said = re.findall(rf"MISRA {re.escape(rule)}: (.+?) \*/", beside)
    return Finding(path.name, line, rule, said[-1] if said else "")


def version() -> str:
    """Of cppcheck; another one reads the rules in another way."""
    told = subprocess.run(["cppcheck", "--version"], check=True, capture_output=True, text=True)
    return told.stdout.split()[-1]


def rows(findings: list[Finding]) -> Iterator[str]:
    """The table of docs/controller.md."""
    counts = Counter(f.rule for f in findings if f.required or f.rule in MANDATORY)
    yield f"| MISRA C:2012, as the addon of cppcheck {version()} reads it | places |"
    yield "|---|---|"
    yield f"| mandatory | {sum(counts[rule] for rule in MANDATORY)} |"
    yield f"| required | {sum(f.required for f in findings)}, each with its reason beside it |"
    reasons: dict[tuple[str, str], list[str]] = {}
    for f in findings:
        if f.required:
            reasons.setdefault((f.rule, f.reason), []).append(f.file)
    for (rule, reason), files in sorted(reasons.items()):
        yield f"| {rule}: {reason} | {len(files)}: {', '.join(sorted(set(files)))} |"
    for rule, what in ADVISORY.items():
        n = sum(f.rule == rule for f in findings)
        if n:
            yield f"| advisory {rule}: {what} | {n} |"


if __name__ == "__main__":
    if shutil.which("cppcheck") is None:
        raise SystemExit("needs cppcheck (Debian)")
    all_of_them = check()
    for one in all_of_them:
        if one.rule not in ADVISORY:
            print(f"{one.file}:{one.line}: {one.rule} {one.reason or 'WITHOUT A REASON'}")
    PAGE.write_text(replace_between(PAGE.read_text("utf-8"), "misra", "\n".join(rows(all_of_them))))
