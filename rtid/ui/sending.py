"""Maps to the controller from the page: what `rtid apply --dry-run` tells is the question.

What is sent is what was read: where the controller makes another story of it than the records, the
page asks anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtid.tell.html import rendered, text
from rtid.tell.story import Story

if TYPE_CHECKING:
    from rtid.apply.session import Plan

SAME = "The controller holds exactly this: nothing to send."


@dataclass(frozen=True)
class Way:
    """Whose maps are sent: project, state folder of its daemon (None: the project's own).

    test_bus: also over a bus that anybody may write to.
    """

    project: Path
    state: Path | None
    test_bus: bool = False


@dataclass(frozen=True)
class Sending:
    """What a transfer would change, what speaks against it, and whether there is anything to do."""

    story: Story
    objections: tuple[str, ...] = ()
    is_same: bool = False

    @property
    def may_go(self) -> bool:
        """Whether a yes sends it."""
        return not self.objections and not self.is_same

    def html(self) -> str:
        """The question."""
        against = [f'<p class="bad">refused: {text(reason)}</p>' for reason in self.objections]
        end = "" if self.objections else f"<p>{SAME if self.is_same else 'Send it?'}</p>"
        return rendered(self.story, {}) + "".join(against) + end


def foretell(way: Way) -> Sending:
    """What the records say of a transfer; nothing at all is sent.  Raises as `apply_map` does."""
    from rtid.apply.session import apply_map  # noqa: PLC0415 - the page's server needs none of it
    from rtid.apply.wish import Wish  # noqa: PLC0415

    wish = Wish(state=way.state, dry_run=True)
    return _foretold(apply_map(way.project, wish, lambda plan: False)[0])


def send(way: Way, seen: Sending, progress: Callable[[int, int], None]) -> str | Sending:
    """Send what was read: what came of it, in words, or what the controller would be sent instead.

    progress hears how many of the chunks have arrived.  Raises as `apply_map` does.
    """
    from rtid.apply.session import apply_map  # noqa: PLC0415 - the page's server needs none of it
    from rtid.apply.wish import Wish  # noqa: PLC0415
    from rtid.tell.applied import ending  # noqa: PLC0415

    wish = Wish(state=way.state, test_bus=way.test_bus)
    plan, row = apply_map(way.project, wish, lambda plan: _foretold(plan) == seen, progress)
    if row is None and _foretold(plan) != seen:
        return _foretold(plan)
    return " ".join(ending(plan, row).split())


def _foretold(plan: Plan) -> Sending:
    """A plan as the page tells it: foretold tracking is the command's, which is given a record."""
    from rtid.tell.applied import story  # noqa: PLC0415 - the page's server needs none of it

    return Sending(story(replace(plan, tracking=None)), plan.objections, plan.is_same)
