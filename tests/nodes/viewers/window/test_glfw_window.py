"""The parts of the window that need no display."""

from __future__ import annotations

import subprocess
import sys

import pytest

from events.base import KEYS
from nodes.viewers.window import letterbox


def test_key_names_are_all_that_glfw_knows() -> None:
    """Every key of GLFW's has a name, and every name is a key of GLFW's."""
    glfw = pytest.importorskip("glfw")
    constants = {name for name in dir(glfw) if name.startswith("KEY_")}
    assert {f"KEY_{name.upper()}" for name in KEYS} == constants - {"KEY_LAST", "KEY_UNKNOWN"}


@pytest.mark.parametrize(
    ("image", "window", "expected"),
    [
        ((640, 480), (640, 480), (0, 0, 640, 480)),
        ((160, 80), (400, 300), (0, 50, 400, 200)),
        ((80, 160), (400, 300), (125, 0, 150, 300)),
        ((640, 480), (64, 96), (0, 24, 64, 48)),
        ((640, 480), (0, 0), (0, 0, 0, 0)),
    ],
)
def test_an_image_fills_the_window_in_one_direction(
    image: tuple[int, int], window: tuple[int, int], expected: tuple[int, ...]
) -> None:
    """Wide, tall, shrunk and minimised: the aspect is kept and the image is in the middle."""
    assert letterbox(*image, *window) == expected


@pytest.mark.slow
def test_importing_the_nodes_imports_neither_glfw_nor_opengl() -> None:
    """A machine without a display, or without the libraries, can import and list the nodes."""
    code = (
        "import sys, nodes.viewers.window, nodes.pilots.teleop, nodes.viewers.window; "
        "print({'glfw', 'OpenGL'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("set()\n", "")
