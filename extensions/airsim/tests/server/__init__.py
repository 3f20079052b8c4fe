"""Tests of `visnav_airsim.server`."""
