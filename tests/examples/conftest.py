"""The display of the tests of windows, for the example that has one."""

from __future__ import annotations

from tests.nodes.viewers.window.conftest import display

__all__ = ["display"]
