"""Remake README's pictures from a demo run: `make pictures`."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from rtid.study.demo import prepare
from rtid.tell.replay import LearnedStory

NAMES = ("residual", "coverage", "slices")
COLOURS, WIDTH = 64, 1100  # small files: README carries them in the repository


def shrink(picture: Path, target: Path) -> None:
    """Write a palette image of README's width."""
    image = Image.open(picture).convert("RGB")
    image = image.resize(
        (WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS
    )
    image.quantize(COLOURS).save(target, optimize=True)


def main(folder: Path) -> None:
    """Learn the demo's machine and draw what it shows."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        comparison = prepare(work).desk(lambda text, share: None)
        LearnedStory(comparison).draw(work, "png")
        for picture in NAMES:
            shrink(work / f"{picture}.png", folder / f"{picture}.png")
            print(f"wrote {folder / picture}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
