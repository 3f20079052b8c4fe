"""Recordings in MCAP: ROS 2's messages for its tools, and the events as they are for replays."""

from nodes.data.recorder.node import McapRecorder
from nodes.data.recorder.writer_process import McapRecorderConfig

__all__ = ["McapRecorder", "McapRecorderConfig"]
