"""The bytes of AirSim's protocol."""

from __future__ import annotations

import numpy as np

from sims.airsim import wire


def test_the_first_bytes_of_airsims_client_are_a_ping() -> None:
    captured = b"\x94\x00\x00\xa4ping\x90"
    decoder = wire.Decoder()
    found = [message for byte in captured for message in decoder.feed(bytes([byte]))]
    assert found == [wire.Request(0, "ping", [])]
    assert wire.request(0, "ping", ()) == captured


def test_floats_are_packed_in_five_bytes_each() -> None:
    numbers = np.array([[1.0, -2.5], [np.inf, 0.0]])
    (found,) = wire.Decoder().feed(wire.reply(7, None, {"data": wire.float_array(numbers)}))
    assert found == wire.Reply(7, None, {"data": [1.0, -2.5, np.inf, 0.0]})
