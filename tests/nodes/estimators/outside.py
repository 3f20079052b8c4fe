"""A program that knows the truth: ``outside.py FILE`` (JSON: poses by stamp, or null)."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nodes.outside.native.client import Link
else:
    from client import Link  # $VISNAV_INCLUDE is the folder of that one file

truth = json.loads(Path(sys.argv[1]).read_text())
with Link("outside") as link:
    link.ready("body")
    began = False
    for frame in link:
        pose = truth[str(frame.stamp)]
        if pose is not None:
            link.pose(frame, pose)
        elif began:
            link.lost(frame)
        else:
            link.initialising(frame)
        began = began or pose is not None
