"""Sources of frames: log files, live buses, serial lines; and tables, which yield samples."""

from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.formats import open_file, open_log, read_table

__all__ = ["LogError", "open_file", "open_log", "read_table"]
