"""Live: what the daemon says of itself."""

from __future__ import annotations

from pathlib import Path


class Live:
    """The daemon's status, from its state folder."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def seen(self, number: str) -> None:
        """A page has drawn an update."""

    def is_due(self) -> bool:
        """True where there is something new."""
        return False

    def fragments(self) -> dict[str, str]:
        """HTML by place."""
        return {}
