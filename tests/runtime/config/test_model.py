"""Settings written back as a file, and what they are by default."""

from __future__ import annotations

import tomllib

import msgspec
import pytest
import tomli_w

from runtime.config.model import NetworkConfig, RunConfig, to_builtins
from runtime.config.reading import parse
from runtime.units import plain

FILE = """
[run]
name = "back"
duration = "3s"

[[nodes]]
name = "speaker"
type = "tests.runtime.samples:Speaker"

[[nodes]]
name = "reader"
type = "tests.runtime.samples:Reader"
inputs.pings = "speaker"
links.pings = { delay = "20ms", loss = 0.25 }
"""


def test_settings_written_back_are_read_as_the_same() -> None:
    config = parse(tomllib.loads(FILE), "c.toml")
    table = to_builtins(config)
    assert parse(tomllib.loads(tomli_w.dumps(table)), "c.toml") == config
    speaker, reader = table["nodes"]
    assert reader["inputs"] == {"pings": "speaker"}
    assert reader["links"]["pings"]["loss"] == 0.25
    assert "inputs" not in speaker
    assert "links" not in speaker
    assert "network" not in table


@pytest.mark.parametrize(
    ("secret", "written"),
    [
        ("env:FLEET_KEY", True),
        ("file:fleet.key", True),
        ("correct horse battery", False),
        ("my env:FLEET_KEY or so", False),
    ],
)
def test_a_literal_secret_is_not_written(secret: str, *, written: bool) -> None:
    network = NetworkConfig(meet="tcp/10.0.0.2:7450", secret=secret)
    config = msgspec.structs.replace(parse(tomllib.loads(FILE), "c.toml"), network=network)
    table = to_builtins(config)
    assert table["network"]["meet"] == "tcp/10.0.0.2:7450"
    assert table["network"].get("secret") == (secret if written else None)


def test_defaults_are_as_documented() -> None:
    assert msgspec.to_builtins(RunConfig(), enc_hook=plain) == {
        "name": "run",
        "clock": "lockstep",
        "speed": None,
        "seed": 0,
        "duration": 0,
        "digest": None,
        "stall": 0.02,
        "startup_limit": 60,
        "shutdown_limit": 10,
        "progress_limit": 5,
        "log": "info",
        "accept": (),
    }
    assert msgspec.to_builtins(NetworkConfig(), enc_hook=plain) == {
        "meet": "tcp/127.0.0.1:7450",
        "zenoh": "",
        "secret": "",
        "shared": True,
        "lease": 0.8,
        "wait": 60,
    }
