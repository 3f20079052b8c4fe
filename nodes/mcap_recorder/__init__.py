"""Recordings in MCAP, with ROS 2's messages for its tools and the events as they are for replays.

`node` listens; `backlog` is what waits, `recording` the thread that hands it, through `pipe`, to
the `process` that writes. There `topics` makes messages of events, and `native` those that hold
an event as it is; `arrays` finds what these lack. `mcap_file` writes and reads files, `layout` and
`records` know what stands in them, sound or not, `disk` writes whole pieces; `recover` mends torn
files. Replays are in `nodes.replay`.
"""

from nodes.mcap_recorder.node import McapRecorder
from nodes.mcap_recorder.settings import McapRecorderConfig

__all__ = ["McapRecorder", "McapRecorderConfig"]
