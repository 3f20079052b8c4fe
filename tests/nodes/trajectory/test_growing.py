"""Files that grow with a run: on the disk within half a second, and whole at its end."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import pytest

from nodes.trajectory.table import GrowingFile, part_name
from runtime import Node, Tick, every
from runtime.errors import NodeError
from runtime.testing import run_node, run_nodes, spec


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


class Restarted(Writing):
    """Fails once, and is brought up again."""

    names: ClassVar[list[str]] = []

    async def run(self) -> None:
        self.names.append(part_name(self, "v1.2/clouds.tar/a.ply"))
        if not self.restarts:
            await self.clock.sleep(0.6)
            raise RuntimeError("now")


def test_a_restart_goes_on_in_the_file_and_gives_others_a_number(tmp_path: Path) -> None:
    """What was written before is still there."""
    run_nodes([spec(Restarted, "node", on_error="restart")], duration=2.1, out=tmp_path)
    head, *lines = (tmp_path / "a.txt").read_text().splitlines()
    assert head == "# head"
    assert lines[:3] == ["0", "1", "2"]
    assert "0" in lines[3:]
    assert Restarted.names == ["v1.2/clouds.tar/a.ply", "v1.2/clouds.tar/a-2.ply"]
