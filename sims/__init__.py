"""Simulators: pure modules for physics, control and cameras, with a thin node for each."""
