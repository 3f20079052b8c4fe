"""Tests with AirSim's own clients, which PyPI has."""
