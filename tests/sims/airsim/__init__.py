"""Tests of `sims.airsim`."""
