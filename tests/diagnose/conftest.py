"""What is diagnosed in one of these modules, another one takes."""

from tests.replays import shared_replays  # noqa: F401
