"""Rerun: a run in three dimensions, live or in a file (the extra `rerun`)."""

from nodes.viewers.rerun.node import RerunView

__all__ = ["RerunView"]
