"""A run, as one page to read: ``report.html`` and its pictures."""

from nodes.report.page import write_report

__all__ = ["write_report"]
