"""Nodes that plug in: keyboard, scripted flights, recorders."""
