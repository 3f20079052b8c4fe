"""A window as a node: shows one camera's images and turns keys into events.

What a key does is decided in `nodes.pilots.teleop`; the window itself is in
`nodes.viewers.window.glfw_window`.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from events import Image, KeyPressed, KeyReleased, WindowClosed, WindowResized
from nodes.viewers.window.glfw_window import Close, GlfwWindow, Key, Size
from runtime import Input, Node, NodeConfig, Output, Tick, Worker, every

Pixels = Annotated[int, msgspec.Meta(ge=1, le=16384)]


class ImageWindowConfig(NodeConfig):
    """Settings of an `ImageWindow`.

    Attributes:
        title: Text of the title bar.
        width: Width of the window's content at the start, pixels.
        height: Height of the window's content at the start, pixels.
        rate: Polls per second of the run's clock; each shows the newest image and reads the keys.
        show_images: Whether images are shown; otherwise the window is for keys only.
    """

    title: str = "visnav"
    width: Pixels = 640
    height: Pixels = 480
    rate: float = 60.0
    show_images: bool = True


class ImageWindow(Node[ImageWindowConfig]):
    """A window that shows images and turns keys into events.

    ::

        [[nodes]]
        name = "window"
        type = "ImageWindow"
        inputs = { images = "drone/front_center" }   # of one camera

    The window lives in a process of its own, so that a slow X server never delays the event loop.
    It is polled on the run's clock; to fly by hand, run with ``clock = "real"`` or ``speed = 1``,
    because simulated time would otherwise pass too fast. Keys that are held when the window loses
    the focus, or when this node ends or fails, are released. Closing the window ends the run,
    unless a node handles `WindowClosed`.

    The stamp of an event is the time of the poll that found it, at most one period after the key
    was pressed.
    """

    ends_run = "hand"
    images = Input(Image, keep="latest")
    key_presses = Output(KeyPressed)
    key_releases = Output(KeyReleased)
    closures = Output(WindowClosed)
    sizes = Output(WindowResized)

    def __init__(self) -> None:
        self._held: set[str] = set()
        self._shown = ""  # source of the last image
        self._warned = False

    async def on_startup(self) -> None:
        """Open the window.

        Raises:
            MissingDependencyError: There is no display.
        """
        settings = self.config
        self._window: Worker[GlfwWindow] = await self.worker(
            GlfwWindow, settings.title, settings.width, settings.height
        )

    @every(hz="rate")
    async def poll(self, tick: Tick) -> None:  # noqa: ARG002
        """Show the newest image, and send what has happened in the window."""
        image = self._newest() if self.config.show_images else None
        for change in await self._window.call(GlfwWindow.poll, image.data if image else None):
            match change:
                case Key(name, down=True):
                    self._press(name)
                case Key(name):
                    self._release(name)
                case Size(width, height):
                    self.sizes.send(
                        WindowResized(
                            stamp=self.clock.now(), source=self.name, width=width, height=height
                        )
                    )
                case Close():
                    self.closures.send(WindowClosed(stamp=self.clock.now(), source=self.name))

    async def on_shutdown(self) -> None:
        """Release the keys that are held, since no later poll can."""
        for key in sorted(self._held):
            self._release(key)

    def _press(self, key: str) -> None:
        self._held.add(key)
        self.key_presses.send(KeyPressed(stamp=self.clock.now(), source=self.name, key=key))

    def _release(self, key: str) -> None:
        self._held.discard(key)
        self.key_releases.send(KeyReleased(stamp=self.clock.now(), source=self.name, key=key))

    def _newest(self) -> Image | None:
        """Return the newest image if it has not been shown yet."""
        try:
            image = self.images.receive_nowait()
        except LookupError:
            return None
        if self._shown not in {"", image.source} and not self._warned:
            self._warned = True
            self.log.warning(
                "images of %s and %s alternate; select one camera in the file: "
                'inputs = { images = "%s" }',
                self._shown,
                image.source,
                image.source,
            )
        self._shown = image.source
        return image
