"""Simulators: pure physics, control and camera modules, and one thin node each."""
