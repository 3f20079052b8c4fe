"""Files that grow with a run: on the disk within half a second, and whole at its end."""

from __future__ import annotations

from pathlib import Path

import pytest

from nodes.trajectory.growing import GrowingFile
from runtime import Node, Tick, every
from runtime.errors import NodeError
from runtime.testing import run_node


class Writing(Node):
    """Adds a line each quarter of a second, and looks at the file before that."""

    seen: list[str]

    async def on_startup(self) -> None:
        assert self.out is not None
        type(self).seen = []
        self.path = self.out / "a.txt"
        self.file = GrowingFile(self, self.path, "# head\n")

    @every(hz=4)
    def add(self, tick: Tick) -> None:
        if self.path.is_file():
            self.seen.append(self.path.read_text())
        self.file.add(f"{tick.index}\n")

    async def on_shutdown(self) -> None:
        self.file.close()


def test_a_line_is_written_within_half_a_second(tmp_path: Path) -> None:
    """Should the run be killed, it is there."""
    run_node(Writing, duration=1.1, out=tmp_path)
    assert Writing.seen == [
        "",
        "# head\n0\n",
        "# head\n0\n",
        "# head\n0\n1\n2\n",
        "# head\n0\n1\n2\n",
    ]
    assert (tmp_path / "a.txt").read_text() == "# head\n0\n1\n2\n3\n4\n"


def test_a_disk_that_is_full_ends_the_run(tmp_path: Path) -> None:
    """Rather than that what is lost goes unseen."""
    (tmp_path / "a.txt").symlink_to("/dev/full")
    with pytest.raises(NodeError, match="No space left"):
        run_node(Writing, duration=1.1, out=tmp_path)
