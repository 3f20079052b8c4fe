"""Report of a run: the page ``report.html`` and its figures.

`page` is the page, and the node that writes it when a run ends; `folder` reads what the run left,
`tables` is that data and its tables, and the others draw.
"""

from nodes.judging.report.page import Report, ReportConfig

__all__ = ["Report", "ReportConfig"]
