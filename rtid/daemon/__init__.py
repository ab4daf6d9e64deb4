"""The on-board daemon: live bus, fixed-rate loop, faults survived, state kept (`rtid run`)."""
