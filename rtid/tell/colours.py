"""Colours and units of signals of all pictures, stills and pages alike; imports nothing heavy."""

from rtid.units import MPA

BLUE, ORANGE, GREEN = "#0072b2", "#d55e00", "#009e73"  # Okabe and Ito
CHAMBERS, MARKERS = (BLUE, ORANGE), ("o", "s")  # one of each per chamber
SEEN, HELD_OUT = "#e6f0f7", "#fdf1dc"  # shades of what the fit has seen, and has not
INK, GREY, LINE, PALE = "#333333", "#8c8c8c", "#c4c4c4", "#e4e4e4"
# of signals: name and factor per SI value
UNITS = {"Pa": ("MPa", MPA), "m": ("mm", 1e3), "m/s": ("mm/s", 1e3)}
