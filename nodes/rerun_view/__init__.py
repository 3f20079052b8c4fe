"""Rerun: a run in three dimensions, live or in a file (`pip install 'visnav-runtime[rerun]'`).

Read in this order: `settings` (what the file says), `node` (what is heard, and how much of it),
`entities` (where things stand in Rerun's tree), `pictures` and `paths` (what is done to them
first), `recorder` (what becomes of each event; lives in a process of its own), `layout` (what the
viewer shows at first), `sdk` (the only import of rerun, and its servers).
"""

from nodes.rerun_view.node import RerunView

__all__ = ["RerunView"]
