"""Recordings in MCAP, with ROS 2's messages for its tools and the events as they are for replays.

`node` takes all events; `backlog` holds those that wait, `writer_process` hands them through `pipe`
to the process that writes (`process`); in `pipe` is all that the two send each other. There
`event_writer` makes messages of events. `recover` repairs files of runs that were killed; what is
in a file is for `nodes.data.mcap`, replays are for `nodes.data.replay`.
"""

from nodes.data.recorder.node import McapRecorder
from nodes.data.recorder.pipe import McapRecorderConfig

__all__ = ["McapRecorder", "McapRecorderConfig"]
