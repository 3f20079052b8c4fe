"""What a flight leaves to look at: its true trajectory, a plot of it, and a sheet of images.

`node` is the node, `drawing` makes the two image files.
"""

from nodes.flight_log.node import FlightLog, FlightLogConfig

__all__ = ["FlightLog", "FlightLogConfig"]
