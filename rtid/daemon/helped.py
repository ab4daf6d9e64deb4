"""A helper without what no helper needs: `python -m rtid.daemon.helped MODULE FD ARGUMENTS...`."""

from __future__ import annotations

import sys
from runpy import run_module

from firmware_bridge.kept_out import keep_out_asammdf

if __name__ == "__main__":
    keep_out_asammdf()
    del sys.argv[0]
    run_module(sys.argv[0], run_name="__main__", alter_sys=True)
