"""Recordings in MCAP, with ROS 2's messages for its tools and the events as they are for replays.

`node` takes all events; `writer_process` holds those that wait, and hands them through `pipe` to
the process that makes messages of them and writes the file (`process`). `recover` repairs files of
runs that were killed; what is in a file is for `nodes.data.mcap`.
"""

from nodes.data.recorder.node import McapRecorder
from nodes.data.recorder.pipe import McapRecorderConfig

__all__ = ["McapRecorder", "McapRecorderConfig"]
