"""Sources of frames: log files, live buses, serial lines; and tables, which yield samples."""

from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.log_file import open_log

__all__ = ["LogError", "open_log"]
