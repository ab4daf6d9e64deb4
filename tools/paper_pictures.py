"""The two pictures of docs/paper.md from what `benchmarks.paper` has drawn: `make paper`."""

from __future__ import annotations

import sys
from pathlib import Path

from tools.readme_pictures import shrink

NAMES = ("fig3", "fig6")


def main(drawn: Path, folder: Path) -> None:
    """Shrink them to a small file each."""
    for name in NAMES:
        target = folder / f"paper_{name}.png"
        shrink(drawn / f"{name}.png", target)
        print(f"wrote {target}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
