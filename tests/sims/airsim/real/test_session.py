"""The real clients connect without a warning, and read our errors as theirs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.sims.airsim.real.environments import CLIENTS
from tests.sims.airsim.real.rig import flown

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # the first one installs its client


@pytest.mark.parametrize("client", CLIENTS)
def test_a_real_client_connects_and_reads_errors(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, drone="") as rig:
        assert rig.script(client, "handshake") == {"ping": True, "vehicles": ["drone"]}
        found = rig.script(client, "errors")
        rig.end()
    unknown, arity, *_ = found["refused"]
    assert unknown == "rpclib: server could not find function 'simNonsense' with argument count 1."
    assert arity.endswith("with an invalid number of arguments. Expected: 1, got: 0")
    assert found["alive"]
    assert "takeoff" in rig.said, "what a future's join hides is logged"
