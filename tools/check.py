"""What a builder runs after each edit: lint, types, layers, and for a minute the tests in reach.

    python -m tools.check [--all] [--since REVISION] [--seconds S]

Of the unit tests that the change touches, the nearest come first.  A unit test starts no process
and is not marked slow; what was skipped is counted and left to `make test`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from tools.touched import Sources, changed

ROOT = Path(__file__).parents[1]
LAYERS = ROOT / "tests" / "test_layers.py"
NOT_UNIT = ("browser", "campaign", "faults", "fuzz")  # folders of what lives in other processes
LINT = (("ruff", "check"), ("ruff", "format", "--check"), ("mypy",))
MOST_S = 40.0  # of processor time per worker: with its start and lint beside it, a minute
NO_TESTS = 5  # pytest's exit code where all are deselected


def touched(since: str) -> list[Path]:
    """Unit test modules that the change touches, nearest first."""
    files = changed(ROOT, since)
    near = Sources(ROOT).tests(files)
    print(f"{len(files)} files changed; {len(near)} test modules import them, near or far")
    return list(near)


def every() -> list[Path]:
    """All test modules."""
    return sorted((ROOT / "tests").rglob("test_*.py"))


def unit(modules: list[Path]) -> list[Path]:
    """The layers, and those of the modules that may hold unit tests."""
    folders = {ROOT / "tests" / name for name in NOT_UNIT}
    return [LAYERS, *(p for p in modules if p != LAYERS and not folders & set(p.parents))]


def lint() -> int:
    """Lint and types; how many of them complain."""
    wrong = 0
    for command in LINT:
        done = subprocess.run(
            [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
        )
        if done.returncode:
            print(f"\n{' '.join(command)}:\n{done.stdout}{done.stderr}", flush=True)
            wrong += 1
    return wrong


def tested(modules: list[Path], most_s: float) -> int:
    """Run the unit tests of these modules; whether something failed."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile"),
            *("--no-loadscope-reorder", "-p", "no:benchmark", "-p", "tools.unit_tests"),
            *("--most", str(most_s)),
            *("-m", "not campaign and not soak and not faults and not long and not slow"),
            *map(str, modules),
        ],
        cwd=ROOT, check=False,
    )  # fmt: skip
    return done.returncode not in {0, NO_TESTS}


def main() -> None:
    """Exit code 1 where something complains."""
    start_s = time.time()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", action="store_true", help="all unit tests, however long")
    parser.add_argument("--since", default="", help="instead of where the branch left main")
    parser.add_argument("--seconds", type=float, default=MOST_S, help="no test begins later")
    wanted = parser.parse_args()
    with ThreadPoolExecutor(1) as beside:
        linted: Future[int] = beside.submit(lint)
        modules = unit(every() if wanted.all else touched(wanted.since))
        failed = tested(modules, float("inf") if wanted.all else wanted.seconds)
        wrong = linted.result() + failed
    print(f"{time.time() - start_s:.0f} s; {'wrong' if wrong else 'nothing is wrong'}")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
