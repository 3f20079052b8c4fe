"""The node that writes the report when a run is over."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from runtime import Node, NodeConfig


class ReportConfig(NodeConfig):
    """Settings of the report.

    Attributes:
        figures: Formats of the figures in ``plots``: png, svg, pdf. The page shows the PNGs; with
            no format at all it has tables only, and takes no time to draw.
    """

    figures: tuple[Literal["png", "svg", "pdf"], ...] = ("png", "svg")


class Report(Node[ReportConfig]):
    """Writes ``report.html`` and its figures, of all that the other nodes left in the run's folder.

    It comes last, after the summary, whether or not an evaluation judged anything. The command
    ``report`` writes the same page anew from the folder.
    """

    files = ("plots", "report.html")

    async def on_shutdown(self) -> None:
        """Have the report written once the other nodes and the summary have left their files."""
        if self.out is not None:
            self.after_run(self._write)

    def _write(self, out: Path) -> None:
        from nodes.judging.report.page import write_report  # matplotlib takes a second to import

        write_report(out, self.config.figures)
