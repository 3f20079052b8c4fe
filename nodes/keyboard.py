"""A window as a node: shows one camera's pictures and tells everyone about keys.

What a key does is not decided here (`nodes.teleop`), and the window itself is in `nodes.window`.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from events import Image, KeyPressed, KeyReleased, WindowClosed, WindowResized
from nodes.window import Close, Key, Size, Window
from runtime import Input, Node, NodeConfig, Output, Tick, Worker, every

Pixels = Annotated[int, msgspec.Meta(ge=1, le=16384)]


class KeyboardConfig(NodeConfig):
    """Settings of a `Keyboard`.

    Attributes:
        title: In the title bar.
        width: Of the window's content at first, pixels.
        height: The same.
        rate: How often the window is asked for news and shown a picture, Hz of the run's clock.
        show: Whether pictures are shown; without, the window is for keys only.
    """

    title: str = "visnav"
    width: Pixels = 640
    height: Pixels = 480
    rate: float = 60.0
    show: bool = True


class Keyboard(Node[KeyboardConfig]):
    """A window that shows pictures and turns keys into events.

    ::

        [[nodes]]
        name = "keyboard"
        type = "nodes.keyboard:Keyboard"
        inputs = { images = "drone/front_center" }   # one camera: several would take turns

    The window lives in a process of its own, so that a slow X server never holds up the loop.
    It is polled on the run's clock; to fly by hand, run with ``clock = "real"`` or ``speed = 1``,
    or simulated time will race past your fingers. Keys that are held when the window loses the
    focus, or when this node ends or fails, are released. Closing the window ends the run, unless
    a node handles `WindowClosed`.

    The stamp of an event is the time at which the poll found it, up to one period after it
    happened.
    """

    images = Input(Image, keep="latest")
    pressed = Output(KeyPressed)
    released = Output(KeyReleased)
    closed = Output(WindowClosed)
    resized = Output(WindowResized)

    def __init__(self) -> None:
        self._held: set[str] = set()
        self._shown = ""  # source of the last picture
        self._warned = False

    async def on_startup(self) -> None:
        """Open the window.

        Raises:
            MissingDependencyError: There is no display.
        """
        settings = self.config
        self._window: Worker[Window] = await self.worker(
            Window, settings.title, settings.width, settings.height
        )

    @every(hz="rate")
    async def poll(self, tick: Tick) -> None:  # noqa: ARG002
        """Show the newest picture and tell what has happened."""
        image = self._newest() if self.config.show else None
        for happening in await self._window.call(Window.poll, image.data if image else None):
            match happening:
                case Key(name, down=True):
                    self._press(name)
                case Key(name):
                    self._release(name)
                case Size(width, height):
                    self.resized.send(
                        WindowResized(
                            stamp=self.clock.now(), source=self.name, width=width, height=height
                        )
                    )
                case Close():
                    self.closed.send(WindowClosed(stamp=self.clock.now(), source=self.name))

    async def on_shutdown(self) -> None:
        """Release what is held: nobody will see it come up."""
        for key in sorted(self._held):
            self._release(key)

    def _press(self, key: str) -> None:
        self._held.add(key)
        self.pressed.send(KeyPressed(stamp=self.clock.now(), source=self.name, key=key))

    def _release(self, key: str) -> None:
        self._held.discard(key)
        self.released.send(KeyReleased(stamp=self.clock.now(), source=self.name, key=key))

    def _newest(self) -> Image | None:
        """Return the newest picture if it has not been shown yet."""
        try:
            image = self.images.receive_nowait()
        except LookupError:
            return None
        if self._shown not in {"", image.source} and not self._warned:
            self._warned = True
            self.log.warning(
                "pictures of %s and %s take turns; narrow them in the file: "
                'inputs = { images = "%s" }',
                self._shown,
                image.source,
                image.source,
            )
        self._shown = image.source
        return image
