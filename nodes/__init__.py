"""Plug-in nodes: keyboard, scripted flights, recorders."""
