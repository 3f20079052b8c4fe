"""Tests of `sims.airsim.server`."""
