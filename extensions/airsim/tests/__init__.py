"""Tests of `visnav_airsim`."""
