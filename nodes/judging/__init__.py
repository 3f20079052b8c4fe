"""Judging: from estimates and truth to figures, verdicts and reports."""
