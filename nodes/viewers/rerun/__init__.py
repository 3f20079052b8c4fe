"""Rerun: a run in three dimensions, live or in a file (the extra `rerun`).

Read in this order: `node` (which events it takes, and how many), `recorder` (what becomes of each
event; lives in a process of its own), `world` and `plots` (what it logs), `entities` (where things
are in Rerun's tree, and what the viewer shows at first), `sdk` (settings, the only import of
rerun).
"""

from nodes.viewers.rerun.node import RerunView

__all__ = ["RerunView"]
