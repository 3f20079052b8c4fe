"""How processes of a run find each other: what a Zenoh file says holds, and no more than that."""

from __future__ import annotations

import contextlib
import ipaddress
import json
import logging
from pathlib import Path

import pytest

from runtime.config.model import NetworkConfig
from runtime.errors import PeerError
from tests.runtime.ports import free_port
from visnav_machines.session import Session, _configuration, _warn_if_open

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


def open_ports() -> set[tuple[str, str, int]]:
    """Return protocol, address and port of what this process listens to."""
    mine, ports = set(), set()
    for file in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            mine.add(str(file.readlink()))
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path("/proc/self/net", table).read_text().splitlines()[1:]:
            fields = line.split()
            address, port = fields[1].split(":")
            raw = bytes.fromhex(address)
            words = b"".join(raw[at : at + 4][::-1] for at in range(0, len(raw), 4))
            if f"socket:[{fields[9]}]" in mine and fields[2].endswith(":0000"):
                ports.add((table[:3], str(ipaddress.ip_address(words)), int(port, 16)))
    return ports


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "[::1]"])
def test_it_listens_at_the_named_address_only(host: str) -> None:
    """Where it is met, and at a port of the address by which that is reached; no datagrams."""
    before, port = open_ports(), free_port()
    session = Session("test", NetworkConfig(meet=f"tcp/{host}:{port}"), b"secret")
    ports = open_ports() - before
    session.close()
    address = host.strip("[]")
    assert ("tcp", address, port) in ports
    assert len(ports) == 2
    assert {entry[:2] for entry in ports} <= {("tcp", ip) for ip in (address, "127.0.0.1")}


@pytest.mark.slow
def test_it_tells_whether_anybody_listens_where_processes_meet(tmp_path: Path) -> None:
    network = NetworkConfig(meet=f"tcp/127.0.0.1:{free_port()}")
    first, second = (Session("test", network, b"secret") for _ in range(2))
    assert not second.deserted()
    first.close()
    assert second.deserted()
    second.close()
    file = tmp_path / "zenoh.json5"
    file.write_text('{ listen: { endpoints: ["tcp/127.0.0.1:0"] } }')  # it means to be found so
    third = Session("test", NetworkConfig(meet=network.meet, zenoh=str(file)), b"secret")
    assert not third.deserted()
    third.close()


OPEN = "can be reached from other machines, and what is said there is not encrypted"


@pytest.mark.parametrize("meet", ["tcp/10.0.0.7:7450", "tcp/0.0.0.0:1", "tcp/[::]:1", "udp/lab:1"])
def test_who_can_be_overheard_is_warned(meet: str, caplog: pytest.LogCaptureFixture) -> None:
    _warn_if_open(_configuration(NetworkConfig(meet=meet)))
    (said,) = caplog.records
    assert (said.name, said.levelno) == ("visnav.runtime", logging.WARNING)
    assert said.getMessage().startswith(meet)
    assert OPEN in said.getMessage()


@pytest.mark.parametrize(
    "meet", ["tcp/127.0.0.1:1", "tcp/[::1]:1", "tcp/localhost:1", "tls/10.0.0.7:1", "quic/lab:1"]
)
def test_who_cannot_is_not(meet: str, caplog: pytest.LogCaptureFixture) -> None:
    _warn_if_open(_configuration(NetworkConfig(meet=meet)))
    assert not caplog.records


@pytest.mark.parametrize(
    ("listen", "warned"),
    [
        ('["tcp/0.0.0.0:1"]', True),
        ('["tls/0.0.0.0:1", "tcp/127.0.0.1:2"]', False),
        ('{ peer: ["tls/0.0.0.0:1", "tcp/10.0.0.7:2"] }', True),
    ],
)
def test_what_a_file_opens_counts_and_not_where_it_would_meet_without(
    listen: str, warned: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(f"{{ listen: {{ endpoints: {listen} }} }}")
    _warn_if_open(_configuration(NetworkConfig(meet="tcp/10.0.0.7:7450", zenoh=str(file))))
    assert (OPEN in caplog.text) is warned


def test_a_run_that_can_be_overheard_says_so(caplog: pytest.LogCaptureFixture) -> None:
    """Whether or not it can listen there: the address is none of this machine."""
    Session("test", NetworkConfig(meet=f"tcp/192.0.2.1:{free_port()}"), b"secret").close()
    assert OPEN in caplog.text
