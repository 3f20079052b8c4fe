"""The server's settings in a run's file."""

from __future__ import annotations

from typing import Annotated

import msgspec

from runtime import NodeConfig


class FoxgloveConfig(NodeConfig):
    """Settings of the server.

    Attributes:
        host: Where it listens. Whoever reaches it can see the run, except pages of other origins;
            hence this machine only, unless the file says otherwise.
        port: The same; 0: any that is free (the log has it).
        origins: Pages that may connect, as browsers name them: Foxglove's own, in a browser and
            as a program. What is no browser needs none.
        image_rate: Images a second of each camera, on the run's clock; of a set (colours,
            depth) all or none. 0: no images.
        jpeg_quality: 1 to 100; 0: images as they are.
        depth: Whether to show depth images, in millimetres.
        clock_rate: How often a second viewers get the run's time.
        backlog: Messages that wait for a viewer that is slow; the oldest is dropped.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 8765
    origins: tuple[str, ...] = ("https://app.foxglove.dev", "file://")
    image_rate: Annotated[float, msgspec.Meta(ge=0, le=1000)] = 15.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=0, le=100)] = 80
    depth: bool = True
    clock_rate: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 50.0
    backlog: Annotated[int, msgspec.Meta(ge=1)] = 1024
