"""Calibrations in the formats of other programs, lint rules for rigs, and the self-test."""
