"""Rerun: a run in three dimensions, live or in a file."""

from visnav_rerun.node import RerunView

__all__ = ["RerunView"]
