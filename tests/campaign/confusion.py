"""What was named for what was hidden: every outcome as a line of a table, and a picture."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import asdict

import matplotlib.pyplot as plt
import numpy as np

from tests.campaign.diagnoses import SILENT, UNKNOWN, Outcome, truth
from tests.campaign.report import FOLDER


def keep(outcomes: list[Outcome]) -> None:
    """Append outcomes to out/campaign/diagnoses.csv."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    rows = [asdict(o.case) | {k: v for k, v in asdict(o).items() if k != "case"} for o in outcomes]
    path = FOLDER / "diagnoses.csv"
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        if is_new:
            writer.writeheader()
        writer.writerows(rows)


def told(outcome: Outcome) -> str:
    """What the diagnosis said, in one word: a right name stands for a set that holds it."""
    if not outcome.named:
        return UNKNOWN if outcome.judgement == UNKNOWN else "none"
    is_right = outcome.judgement not in (SILENT, UNKNOWN) and outcome.judgement != "wrong name"
    return truth(outcome.case.effect) if is_right else outcome.named


def confusion(outcomes: list[Outcome], title: str) -> None:
    """A picture of counts: hidden effects down, names across; on the diagonal they are right."""
    counts = Counter((o.case.effect, told(o)) for o in outcomes)
    hidden = list(dict.fromkeys(o.case.effect for o in outcomes))
    names = [*hidden, *sorted({n for _, n in counts} - set(hidden))]
    table = np.array([[counts[h, n] for n in names] for h in hidden])
    figure, axes = plt.subplots(figsize=(0.42 * len(names) + 3, 0.42 * len(hidden) + 2.6))
    axes.imshow(table, cmap="Blues", vmin=0, vmax=table.max())
    for (i, j), n in np.ndenumerate(table):
        if n:
            dark = "white" if n > 0.6 * table.max() else "black"
            axes.text(j, i, str(n), ha="center", va="center", color=dark)
    axes.set_xticks(range(len(names)), [n.replace("_", " ") for n in names], rotation=90)
    axes.set_yticks(range(len(hidden)), [h.replace("_", " ") for h in hidden])
    axes.set(xlabel="named (none: nothing, or negligible)", ylabel="hidden", title=title)
    figure.savefig(FOLDER / f"confusion {title}.png".replace(",", "").replace(" ", "_"),
                   bbox_inches="tight", dpi=120)  # fmt: skip
    plt.close(figure)
