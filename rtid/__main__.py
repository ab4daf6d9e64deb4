"""`python -m rtid` is `rtid`."""

from rtid.cli.main import main

main()
