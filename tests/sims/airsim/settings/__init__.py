"""Tests of reading AirSim's settings.json."""
