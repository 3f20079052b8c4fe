"""A window as a node, by GLFW and OpenGL in a process of its own: images shown, keys as events."""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import Image, KeyPressed, KeyReleased, WindowClosed, WindowResized
from events.base import KEYS, LABELS
from runtime import Input, Node, NodeConfig, Output, Tick, Worker, every
from runtime.errors import MissingDependencyError

Change = KeyPressed | KeyReleased | WindowResized | WindowClosed
_UNSTAMPED: Any = {"stamp": 0, "source": ""}  # the node stamps and signs them


class GlfwWindow:
    """Window on the user's display for the newest image; needs the main thread of its process.

    Letters and punctuation are named by the label in the user's layout, other keys (and those not
    in ASCII) by their position on a US keyboard. Sizes are in screen coordinates (mostly pixels).

    Raises:
        MissingDependencyError: There is no display, no OpenGL on it, or a library is missing.
    """

    def __init__(self, title: str, width: int, height: int) -> None:
        self._changes: list[Change] = []
        self._held: dict[int, str] = {}  # physical key to the name by which it went down
        self._error = ""
        self._stale = True
        self._glfw = glfw = _import_glfw()
        glfw.set_error_callback(self._on_error)  # instead of glfw's, which prints warnings
        if not glfw.init():
            raise MissingDependencyError(_no_display("a display (X11 or Wayland)", self._error))
        self._window = glfw.create_window(width, height, title, None, None)
        if not self._window:
            glfw.terminate()
            raise MissingDependencyError(_no_display("a display with OpenGL", self._error))
        self._positions = {getattr(glfw, f"KEY_{name.upper()}"): name for name in KEYS}
        glfw.set_key_callback(self._window, self._on_key)
        glfw.set_window_focus_callback(self._window, self._on_focus)
        glfw.set_window_close_callback(self._window, self._on_close)
        glfw.set_framebuffer_size_callback(self._window, self._on_size)
        glfw.set_window_refresh_callback(self._window, self._on_damage)
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)  # a poll must not wait for the screen
        self._canvas = _Canvas(wayland=glfw.get_platform() == glfw.PLATFORM_WAYLAND)

    def poll(self, image: npt.NDArray[np.uint8] | None = None) -> list[Change]:
        """Show an image, and return the changes since the last poll, in order and without stamps.

        Args:
            image: uint8, shape (height, width, 3) RGB or (height, width) grey; `None` keeps the
                last one.

        Raises:
            ValueError: The image has another type or shape.
        """
        if image is not None:
            self._canvas.upload(image)
            self._stale = True
        self._glfw.poll_events()
        if self._stale:
            self._canvas.draw(*self._glfw.get_framebuffer_size(self._window))
            self._glfw.swap_buffers(self._window)
            self._stale = False
        changes, self._changes = self._changes, []
        return changes

    def close(self) -> None:
        """Close the window."""
        self._glfw.destroy_window(self._window)
        self._glfw.terminate()

    # What GLFW calls inside `poll_events`.

    def _on_key(self, _: Any, key: int, scancode: int, action: int, _mods: int) -> None:
        physical = key if key != self._glfw.KEY_UNKNOWN else -scancode
        if action == self._glfw.PRESS and physical not in self._held:
            self._held[physical] = name = self._name(key, scancode)
            self._changes.append(KeyPressed(key=name, **_UNSTAMPED))
        elif action == self._glfw.RELEASE and physical in self._held:
            self._changes.append(KeyReleased(key=self._held.pop(physical), **_UNSTAMPED))

    def _name(self, key: int, scancode: int) -> str:
        position: str = self._positions.get(key, f"scancode_{scancode}")
        if position not in LABELS.values():  # digits too: some layouts have them behind shift
            return position
        label = self._glfw.get_key_name(key, scancode) or ""
        return LABELS.get(label.lower(), position)

    def _on_focus(self, _: Any, focused: int) -> None:
        # Their releases will not be reported, and a stuck key flies a vehicle away. GLFW releases
        # the keys that it knows, after this.
        if not focused:
            self._changes += [KeyReleased(key=name, **_UNSTAMPED) for name in self._held.values()]
            self._held.clear()

    def _on_close(self, _: Any) -> None:
        self._changes.append(WindowClosed(**_UNSTAMPED))  # and the window stays until the run ends

    def _on_size(self, _: Any, width: int, height: int) -> None:
        self._changes.append(WindowResized(width=width, height=height, **_UNSTAMPED))
        self._stale = True

    def _on_damage(self, _: Any) -> None:
        self._stale = True

    def _on_error(self, _: int, description: bytes) -> None:
        self._error = description.decode(errors="replace")


class _Canvas:
    def __init__(self, *, wayland: bool) -> None:
        # PyOpenGL must look for functions where GLFW made the context; a MUJOCO_GL or
        # PYOPENGL_PLATFORM of "egl" or "osmesa" is meant for the renderers.
        if sys.platform == "linux":
            os.environ["PYOPENGL_PLATFORM"] = "wayland" if wayland else "x11"
        try:
            from OpenGL import GL
        except ImportError as error:
            raise MissingDependencyError(
                f"expected PyOpenGL, found none ({error}): pip install pyopengl"
            ) from None
        self._gl: Any = GL
        self._shape: tuple[int, ...] = ()
        GL.glEnable(GL.GL_TEXTURE_2D)
        GL.glBindTexture(GL.GL_TEXTURE_2D, GL.glGenTextures(1))
        for name in (GL.GL_TEXTURE_MIN_FILTER, GL.GL_TEXTURE_MAG_FILTER):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, name, GL.GL_LINEAR)
        for name in (GL.GL_TEXTURE_WRAP_S, GL.GL_TEXTURE_WRAP_T):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, name, GL.GL_CLAMP_TO_EDGE)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)  # rows are packed

    def upload(self, image: npt.NDArray[np.uint8]) -> None:
        """Make an image the texture; an image of the last shape reuses the memory."""
        if image.dtype != np.uint8 or not (image.ndim == 2 or image.shape[2:] == (3,)):
            raise ValueError(
                "expected a uint8 image of shape (height, width, 3) or (height, width), "
                f"found {image.dtype} of shape {image.shape}"
            )
        gl = self._gl
        image = np.ascontiguousarray(image)
        height, width = image.shape[:2]
        form = gl.GL_RGB if image.ndim == 3 else gl.GL_LUMINANCE
        kind = (form, gl.GL_UNSIGNED_BYTE, ctypes.c_void_p(image.ctypes.data))
        if image.shape == self._shape:
            gl.glTexSubImage2D(gl.GL_TEXTURE_2D, 0, 0, 0, width, height, *kind)
        else:
            gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, form, width, height, 0, *kind)
            self._shape = image.shape

    def draw(self, width: int, height: int) -> None:
        """Draw the image as large as fits into so many pixels, in the middle."""
        gl = self._gl
        gl.glClear(gl.GL_COLOR_BUFFER_BIT)
        if not self._shape:
            return
        gl.glViewport(*letterbox(self._shape[1], self._shape[0], width, height))
        gl.glBegin(gl.GL_TRIANGLE_STRIP)
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):  # v = 0 is the first row, at the top
            gl.glTexCoord2i(x, y)
            gl.glVertex2i(2 * x - 1, 1 - 2 * y)
        gl.glEnd()


def letterbox(width: int, height: int, into_width: int, into_height: int) -> tuple[int, ...]:
    """Return x, y, width, height of an image scaled to fit, in the middle, its aspect kept."""
    scale = min(into_width / width, into_height / height)
    w, h = round(width * scale), round(height * scale)
    return (into_width - w) // 2, (into_height - h) // 2, w, h


def _import_glfw() -> Any:
    try:
        import glfw
    except ImportError as error:
        raise MissingDependencyError(
            f"expected glfw, found none ({error}): pip install glfw"
        ) from None
    return glfw


def _no_display(expected: str, error: str) -> str:
    displays = [f"{n}={os.environ[n]}" for n in ("DISPLAY", "WAYLAND_DISPLAY") if os.environ.get(n)]
    if displays or sys.platform != "linux":
        why = ", ".join([*displays, error.strip()])
    else:
        why = "DISPLAY is not set"
    return (
        f"expected {expected}, found none ({why}); run headless, without this node, "
        "or under Xvfb (`xvfb-run -a python -m runtime run …`)"
    )


Pixels = Annotated[int, msgspec.Meta(ge=1, le=16384)]


class ImageWindowConfig(NodeConfig):
    """Settings of an `ImageWindow`.

    Attributes:
        title: Text of the title bar.
        width: Initial width of the content, pixels.
        height: Initial height of the content, pixels.
        rate: Polls per second of the run's clock; each shows the newest image and reads the keys.
        show_images: Whether images are shown; else keys only.
    """

    title: str = "visnav"
    width: Pixels = 640
    height: Pixels = 480
    rate: float = 60.0
    show_images: bool = True


class ImageWindow(Node[ImageWindowConfig]):
    """Window to show images and turn keys into events.

    ::

        [[nodes]]
        name = "window"
        type = "ImageWindow"
        inputs = { images = "drone/front_center" }   # of one camera

    The window's process is polled on the run's clock; to fly by hand, run with ``clock = "real"``
    or ``speed = 1``. Held keys are released when the window loses the focus, or this node ends.
    Closing the window ends the run, unless a node handles `WindowClosed`. An event's stamp is its
    poll's time, at most one period late.
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
        """Open the window; a `MissingDependencyError` if there is no display."""
        settings = self.config
        self._window: Worker[GlfwWindow] = await self.worker(
            GlfwWindow, settings.title, settings.width, settings.height
        )

    @every(hz="rate")
    async def poll(self, tick: Tick) -> None:  # noqa: ARG002
        """Show the newest image, and send the window's changes."""
        image = self._newest() if self.config.show_images else None
        for change in await self._window.call(GlfwWindow.poll, image.data if image else None):
            self._send(change)

    async def on_shutdown(self) -> None:
        """Release the held keys, since no later poll can."""
        for key in sorted(self._held):
            self._send(KeyReleased(key=key, **_UNSTAMPED))

    def _send(self, change: Change) -> None:
        change = msgspec.structs.replace(change, stamp=self.clock.now(), source=self.name)
        match change:
            case KeyPressed(key=key):
                self._held.add(key)
                self.key_presses.send(change)
            case KeyReleased(key=key):
                self._held.discard(key)
                self.key_releases.send(change)
            case WindowResized():
                self.sizes.send(change)
            case WindowClosed():
                self.closures.send(change)

    def _newest(self) -> Image | None:
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
