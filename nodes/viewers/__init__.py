"""Viewers: windows and programs to show a run."""
