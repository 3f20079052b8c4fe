"""The view's settings in a run's file."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from runtime import NodeConfig
from runtime.paths import OutputPath

_Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]
_Rate = Annotated[float, msgspec.Meta(ge=0, le=1000)]
_Stride = Annotated[int, msgspec.Meta(ge=1, le=64)]


class RerunConfig(NodeConfig):
    """Settings of the view.

    Attributes:
        mode: ``save``: into `file`. ``spawn``: in Rerun's own window. ``serve``: in the browser;
            the log has the address.
        file: In the run's folder; ``rerun`` opens it.
        web_port: Of the page, for ``serve``.
        port: Of the data, for ``serve`` and ``spawn``.
        host: Where the viewer listens. Whoever reaches it sees all, and can send; hence this
            machine only, unless the file says otherwise.
        memory: What the server of ``serve`` keeps for browsers that come late.
        image_rate: Images a second of each camera, on the run's clock; of a set (colours,
            depth) all or none. 0: no images.
        jpeg_quality: 1 to 100; 0: images as they are, which makes large files.
        depth: Whether to show depth images, to the centimetre.
        depth_stride: Show every n-th pixel of every n-th row of them.
        points_rate: A second: depth images with colours are put into the world as points, where
            the camera truly was. 0: never.
        points_stride: Take every n-th pixel of every n-th row for that.
        points_max_distance: Metres; what is farther is left out.
        points_max_height: Metres above the camera; what is higher is left out, so that one can look
            into a room from above.
        update_rate: How often a second new events are passed on to the viewer. (What goes into a
            file is gathered for longer, which makes it smaller.)
    """

    mode: Literal["save", "spawn", "serve"] = "save"
    file: Annotated[OutputPath, msgspec.Meta(pattern=r"^[\w.-]+\.rrd$")] = "flight.rrd"
    web_port: _Port = 9090
    port: _Port = 9876
    host: str = "127.0.0.1"
    memory: Annotated[str, msgspec.Meta(pattern=r"^\d+(MiB|GiB|MB|GB|%)$")] = "1GiB"
    image_rate: _Rate = 5.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=0, le=100)] = 80
    depth: bool = True
    depth_stride: _Stride = 2
    points_rate: _Rate = 2.0
    points_stride: _Stride = 6
    points_max_distance: Annotated[float, msgspec.Meta(gt=0)] = 8.0
    points_max_height: float = 0.5
    update_rate: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 20.0
