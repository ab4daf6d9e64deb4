"""The estimator in C for a controller: its tables from the declared machine, its memory read back.

The sources lie in `firmware_bridge/c` (rtid_estimator*.h, *.c); what they do is the integral form
with Taylor blocks for one chamber and its metering edges, as `rtid.estimator` does it.
"""
