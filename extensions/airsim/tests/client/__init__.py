"""Tests of `visnav_airsim.client`."""
