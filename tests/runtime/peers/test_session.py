"""How processes of a run find each other: what a Zenoh file says holds, and no more than that."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from runtime.config import NetworkConfig
from runtime.errors import PeerError
from runtime.peers.session import _configuration

KEYS = ("mode", "scouting/multicast/enabled", "listen/endpoints", "connect/endpoints")


def said(network: NetworkConfig) -> list[object]:
    configuration = _configuration(network)
    return [json.loads(configuration.get_json(key)) for key in KEYS]


def test_by_default_nobody_elsewhere_is_heard() -> None:
    meet = NetworkConfig().meet
    assert said(NetworkConfig()) == ["peer", False, [meet, "tcp/127.0.0.1:0"], [meet]]


def test_what_a_file_leaves_out_is_as_without_it(tmp_path: Path) -> None:
    """One that speaks of certificates only opens nothing to the world."""
    file = tmp_path / "zenoh.json5"
    file.write_text('{ transport: { link: { tls: { root_ca_certificate: "ca.pem" } } } }')
    network = NetworkConfig(zenoh=str(file))
    assert said(network) == said(NetworkConfig())
    configuration = _configuration(network)
    assert "ca.pem" in configuration.get_json("transport/link/tls/root_ca_certificate")


def test_what_a_file_says_holds(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text('{ mode: "client", connect: { endpoints: ["tls/host:7447"] } }')
    mode, _, _, connect = said(NetworkConfig(zenoh=str(file)))
    assert (mode, connect) == ("client", ["tls/host:7447"])


@pytest.mark.parametrize("text", [None, "{ mode: ", "{ nonsense: 1 }"])
def test_a_file_that_is_none_is_named(text: str | None, tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    if text is not None:
        file.write_text(text)
    with pytest.raises(PeerError, match=r"network.zenoh: .*zenoh.json5"):
        said(NetworkConfig(zenoh=str(file)))
