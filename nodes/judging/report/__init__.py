"""A run as one page to read, ``report.html``, and its figures.

`node` writes it when a run ends; `page` is the page, `folder` reads what the run left, and the
others draw one figure each.
"""

from nodes.judging.report.page import Report, ReportConfig

__all__ = ["Report", "ReportConfig"]
