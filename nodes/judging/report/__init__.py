"""Report of a run: the page ``report.html`` and its figures."""

from nodes.judging.report.page import Report, ReportConfig

__all__ = ["Report", "ReportConfig"]
