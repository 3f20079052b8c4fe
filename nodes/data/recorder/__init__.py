"""Recordings in MCAP: ROS 2's messages for its tools, and the events as they are for replays.

`node` takes events; `writer_process` queues them, and feeds them through `pipe` to the process that
encodes and writes (`process`). `recover` repairs files of killed runs.
"""

from nodes.data.recorder.node import McapRecorder
from nodes.data.recorder.pipe import McapRecorderConfig

__all__ = ["McapRecorder", "McapRecorderConfig"]
