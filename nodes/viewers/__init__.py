"""Viewers: windows and programs that show a run."""
