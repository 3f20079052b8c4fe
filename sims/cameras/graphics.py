"""Opening a GL context without a screen, with an error that names what is missing.

Nothing happens on import: the environment is changed by `open_context`, which must run in the
thread that will render, before any other GL context of the process.
"""

from __future__ import annotations

import ctypes
import importlib
import os
from typing import Any

from runtime.errors import MissingDependencyError

INSTALL = "apt-get install libegl1 libgl1 libgl1-mesa-dri"


class GraphicsError(MissingDependencyError, RuntimeError):
    """Rendering is impossible here: the machine's GL libraries or drivers are missing or broken."""


def keep_memory() -> None:
    """Have the allocator keep what images leave behind, in the place of giving it back each time.

    glibc maps a large array anew, page by page: for each image that took a tenth of the time of a
    plain camera, and a third of that of one with all effects. Does nothing where there is no glibc.
    """
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD of malloc.h
        mallopt(-3, 1 << 25)  # M_MMAP_THRESHOLD: the most that it takes


def open_context(width: int, height: int, threads: int) -> Any:
    """Return a current off-screen GL context: EGL's, or OSMesa's where MUJOCO_GL asks for it.

    Args:
        width: Width of the largest image, pixels.
        height: Height of the largest image, pixels.
        threads: Threads of the software renderer; takes effect with the first context only.

    Raises:
        GraphicsError: There is no GL; the message names what to install.
    """
    # Read by llvmpipe when its first screen is made; by default it takes every core.
    os.environ["LP_NUM_THREADS"] = str(threads)
    backend = "osmesa" if os.environ.get("MUJOCO_GL", "").lower() == "osmesa" else "egl"
    os.environ.setdefault("MUJOCO_GL", backend)
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # PyOpenGL and the drivers fail in many ways
        raise GraphicsError(
            f"cannot render: expected a working {backend.upper()}, found none "
            f"({type(error).__name__}: {error}). On Debian or Ubuntu: {INSTALL} "
            "(or libosmesa6, and MUJOCO_GL=osmesa in the environment)"
        ) from error
    return context


def gl_renderer() -> str:
    """Return the name of the present context's renderer: ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
    gl = importlib.import_module("OpenGL.GL")
    return bytes(gl.glGetString(gl.GL_RENDERER)).decode(errors="replace")


def set_fog(start: float, end: float) -> None:
    """Set the distances (metres) between which the present context's fog grows to its full.

    MuJoCo sets them once, when a model enters a context.
    """
    gl = importlib.import_module("OpenGL.GL")
    gl.glFogf(gl.GL_FOG_START, start)
    gl.glFogf(gl.GL_FOG_END, end)
