"""Tests of `sims.airsim.client`."""
