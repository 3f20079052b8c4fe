"""A window that shows one camera's images and turns keys into events."""

from nodes.viewers.window.node import ImageWindow, ImageWindowConfig

__all__ = ["ImageWindow", "ImageWindowConfig"]
