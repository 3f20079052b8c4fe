"""A window that shows pictures and reports keys: what lives in the worker of `nodes.keyboard`.

The only module that imports glfw and OpenGL, and not before a `Window` is made. No events and no
asyncio here: what happens in the window goes back to the node as small structs.
"""

from __future__ import annotations

import ctypes
import os
import string
import sys
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from runtime.errors import MissingDependencyError

_LABELS = {letter: letter for letter in string.ascii_lowercase} | {
    "'": "apostrophe",
    ",": "comma",
    "-": "minus",
    ".": "period",
    "/": "slash",
    ";": "semicolon",
    "=": "equal",
    "[": "left_bracket",
    "\\": "backslash",
    "]": "right_bracket",
    "`": "grave_accent",
}

_BY_PLACE = """
    escape enter tab space backspace insert delete right left down up page_up page_down home end
    caps_lock scroll_lock num_lock print_screen pause menu world_1 world_2
    left_shift left_control left_alt left_super right_shift right_control right_alt right_super
    kp_decimal kp_divide kp_multiply kp_subtract kp_add kp_enter kp_equal
"""

KEYS = frozenset(
    [*_LABELS.values(), *string.digits, *_BY_PLACE.split()]
    + [f"kp_{n}" for n in range(10)]
    + [f"f{n}" for n in range(1, 26)]
)
"""Names of all keys there are; anything else on a keyboard is ``scancode_`` and a number."""


class Key(msgspec.Struct, frozen=True, gc=False):
    """A key went down or came up."""

    name: str
    down: bool


class Size(msgspec.Struct, frozen=True, gc=False):
    """The window has a new size in pixels."""

    width: int
    height: int


class Close(msgspec.Struct, frozen=True, gc=False):
    """The user wants the window closed."""


Happening = Key | Size | Close


class Window:
    """A window of the display's, with the newest picture in it.

    Needs the main thread of its process; draws only when there is something new to show. Letters
    and punctuation are named by what the user's layout has on the key, all other keys (and those
    whose label is not ASCII) by their place on a US keyboard.

    Args:
        title: In the title bar.
        width: Of the window's content at first, in screen coordinates (mostly pixels).
        height: The same.

    Raises:
        MissingDependencyError: There is no display, no OpenGL on it, or a library is missing.
    """

    def __init__(self, title: str, width: int, height: int) -> None:
        self._happened: list[Happening] = []
        self._held: dict[int, str] = {}  # physical key to the name by which it went down
        self._trouble = ""
        self._stale = True
        self._glfw = glfw = _import_glfw()
        glfw.set_error_callback(self._on_error)  # instead of glfw's, which prints warnings
        if not glfw.init():
            raise MissingDependencyError(_no_display("a display (X11 or Wayland)", self._trouble))
        self._window = glfw.create_window(width, height, title, None, None)
        if not self._window:
            glfw.terminate()
            raise MissingDependencyError(_no_display("a display with OpenGL", self._trouble))
        self._positions = {getattr(glfw, f"KEY_{name.upper()}"): name for name in KEYS}
        glfw.set_key_callback(self._window, self._on_key)
        glfw.set_window_focus_callback(self._window, self._on_focus)
        glfw.set_window_close_callback(self._window, self._on_close)
        glfw.set_framebuffer_size_callback(self._window, self._on_size)
        glfw.set_window_refresh_callback(self._window, self._on_damage)
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)  # a poll must not wait for the screen
        self._canvas = _Canvas(wayland=glfw.get_platform() == glfw.PLATFORM_WAYLAND)

    def poll(self, picture: npt.NDArray[np.uint8] | None = None) -> list[Happening]:
        """Show a picture, and return what has happened since the last poll, in order.

        Args:
            picture: uint8, shape (height, width, 3) RGB or (height, width) grey, top row first;
                `None` leaves the last one.

        Raises:
            ValueError: The picture is something else.
        """
        if picture is not None:
            self._canvas.upload(picture)
            self._stale = True
        self._glfw.poll_events()
        if self._stale:
            self._canvas.draw(*self._glfw.get_framebuffer_size(self._window))
            self._glfw.swap_buffers(self._window)
            self._stale = False
        happened, self._happened = self._happened, []
        return happened

    def close(self) -> None:
        """Close the window."""
        self._glfw.destroy_window(self._window)
        self._glfw.terminate()

    # What GLFW calls inside `poll_events`.

    def _on_key(self, _: Any, key: int, scancode: int, action: int, _mods: int) -> None:
        physical = key if key != self._glfw.KEY_UNKNOWN else -scancode
        if action == self._glfw.PRESS and physical not in self._held:
            self._held[physical] = name = self._name(key, scancode)
            self._happened.append(Key(name, down=True))
        elif action == self._glfw.RELEASE and physical in self._held:
            self._happened.append(Key(self._held.pop(physical), down=False))

    def _name(self, key: int, scancode: int) -> str:
        position: str = self._positions.get(key, f"scancode_{scancode}")
        if position not in _LABELS.values():  # digits too: some layouts have them behind shift
            return position
        label = self._glfw.get_key_name(key, scancode) or ""
        return _LABELS.get(label.lower(), position)

    def _on_focus(self, _: Any, focused: int) -> None:
        # Nobody will say when they come up, and a stuck key flies a vehicle away. GLFW releases
        # the keys that it knows, after this.
        if not focused:
            self._happened += [Key(name, down=False) for name in self._held.values()]
            self._held.clear()

    def _on_close(self, _: Any) -> None:
        self._happened.append(Close())  # and the window stays until the run ends

    def _on_size(self, _: Any, width: int, height: int) -> None:
        self._happened.append(Size(width, height))
        self._stale = True

    def _on_damage(self, _: Any) -> None:
        self._stale = True

    def _on_error(self, _: int, description: bytes) -> None:
        self._trouble = description.decode(errors="replace")


class _Canvas:
    """One textured rectangle in the current OpenGL context."""

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

    def upload(self, picture: npt.NDArray[np.uint8]) -> None:
        """Make a picture the texture; a picture like the last one goes into the same memory."""
        if picture.dtype != np.uint8 or not (picture.ndim == 2 or picture.shape[2:] == (3,)):
            raise ValueError(
                "expected a uint8 picture of shape (height, width, 3) or (height, width), "
                f"found {picture.dtype} of shape {picture.shape}"
            )
        gl = self._gl
        picture = np.ascontiguousarray(picture)
        height, width = picture.shape[:2]
        form = gl.GL_RGB if picture.ndim == 3 else gl.GL_LUMINANCE
        kind = (form, gl.GL_UNSIGNED_BYTE, ctypes.c_void_p(picture.ctypes.data))
        if picture.shape == self._shape:
            gl.glTexSubImage2D(gl.GL_TEXTURE_2D, 0, 0, 0, width, height, *kind)
        else:
            gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, form, width, height, 0, *kind)
            self._shape = picture.shape

    def draw(self, width: int, height: int) -> None:
        """Draw the picture as large as fits into so many pixels, in the middle."""
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
    """Return x, y, width, height of a picture scaled to fit, in the middle, its aspect kept."""
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


def _no_display(expected: str, trouble: str) -> str:
    """Return one line that says what is missing, and how to do without it."""
    displays = [f"{n}={os.environ[n]}" for n in ("DISPLAY", "WAYLAND_DISPLAY") if os.environ.get(n)]
    if displays or sys.platform != "linux":
        why = ", ".join([*displays, trouble.strip()])
    else:
        why = "DISPLAY is not set"
    return (
        f"expected {expected}, found none ({why}); run headless, without this node, "
        "or under Xvfb (`xvfb-run -a python -m runtime run …`)"
    )
