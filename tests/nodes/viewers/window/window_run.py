"""A run with a window, which its tests start in a process of its own.

    python -m tests.nodes.viewers.window.window_run '{"run": {…}, "nodes": […]}'

Prints what the nodes say as lines of JSON, so that a test can wait for it.
"""

from __future__ import annotations

import json
import logging
import sys
from typing import Literal

import numpy as np

from events import Event, Image, KeyPressed, KeyReleased, WindowClosed, WindowResized
from runtime import Node, NodeConfig, Output, Tick, VisnavError, every, on
from runtime.config.reading import parse
from runtime.run.execute import execute

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)


class Listener(Node):
    """Prints what it hears of a window, after a line that says that the run has begun."""

    async def run(self) -> None:
        print(json.dumps({"event": "begun"}), flush=True)

    @on(KeyPressed, KeyReleased, WindowClosed, WindowResized)
    def tell(self, event: Event) -> None:
        fields = {name: getattr(event, name) for name in event.__struct_fields__}
        print(json.dumps({"event": type(event).__name__} | fields), flush=True)


class Stubborn(Node):
    """Does not let a window end the run."""

    @on(WindowClosed)
    def keep(self, event: WindowClosed) -> bool:
        return True


class PainterConfig(NodeConfig):
    encoding: Literal["rgb8", "mono8", "rgba8"] = "rgb8"
    width: int = 160
    height: int = 80


class Painter(Node[PainterConfig]):
    """A camera whose image is red and green above, blue and white below."""

    images = Output(Image)

    @every(hz=20)
    def paint(self, tick: Tick) -> None:
        width, height = self.config.width, self.config.height
        data = np.empty((height, width, 3), np.uint8)
        data[: height // 2, : width // 2] = RED
        data[: height // 2, width // 2 :] = GREEN
        data[height // 2 :, : width // 2] = BLUE
        data[height // 2 :, width // 2 :] = WHITE
        if self.config.encoding == "mono8":
            data = data[:, :, 0]  # not contiguous, as a crop would be
        elif self.config.encoding == "rgba8":
            data = np.dstack([data, data[:, :, 0]])
        self.images.send(
            Image(
                stamp=tick.stamp,
                source=self.name,
                frame_id="camera",
                encoding=self.config.encoding,
                data=data,
            )
        )


def main() -> int:
    """Run what the argument says."""
    log = logging.StreamHandler(sys.stderr)
    try:
        summary = execute(parse(json.loads(sys.argv[1]), "test"), handlers=[log])
    except VisnavError as error:
        print(json.dumps({"event": "failed", "error": str(error)}))
        return 2
    print(json.dumps({"event": "ended", "reason": summary.reason}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
