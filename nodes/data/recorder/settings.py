"""The recorder's settings in a run's file."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from nodes.data.mcap.mcap_file import Compression
from nodes.data.recorder.backlog import WhenFull
from nodes.ros2.messages.typestore import Distribution
from runtime import NodeConfig
from runtime.paths import OutputPath

Bytes = Annotated[int, msgspec.Meta(ge=1 << 16)]
ChunkBytes = Annotated[int, msgspec.Meta(ge=1 << 16, le=1 << 28)]


class McapRecorderConfig(NodeConfig):
    """Settings of a recording.

    Attributes:
        file: Its name in the run's folder. An older one is replaced.
        image_format: How images are kept: ``raw``, ``png`` (smaller, and no loss), or
            ``jpeg`` (small; a replay gives what is left).
        depth_format: How depth images are kept: ``raw``, or ``png``: whole millimetres, up to 65 m.
        jpeg_quality: 1 to 100.
        compression: Of the file's chunks: ``zstd``, ``lz4`` (quicker, larger) or ``none``.
        chunk_size: Bytes of a chunk before compression. A chunk also ends 0.4 s after its
            first event, real or on the run's clock.
        memory: Bytes of events that may wait to be written.
        when_full: What happens if more would wait. ``wait``: simulated time waits for the disk;
            real time cannot, and does as ``drop_images``: images and clouds are left out until
            there is room. A process that shows no sign of life for 10 s while it is waited for
            ends the run. ``drop_oldest``: what has waited longest is left out. What is left out
            is counted among the run's drops, and logged. What the disk has not taken when the run
            ends is written afterwards, before the command returns.
        fsync: Wait for the disk at the end of each chunk. Without it, what is written survives
            the end of the process, but not a power cut.
        distribution: Of ROS 2, whose types the messages have.
    """

    file: Annotated[OutputPath, msgspec.Meta(pattern=r"^[^/]+\.mcap$")] = "recording.mcap"
    image_format: Literal["raw", "png", "jpeg"] = "raw"
    depth_format: Literal["raw", "png"] = "raw"
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90
    compression: Compression = "zstd"
    chunk_size: ChunkBytes = 4 << 20
    memory: Bytes = 256 << 20
    when_full: WhenFull = "wait"
    fsync: bool = False
    distribution: Distribution = "jazzy"
