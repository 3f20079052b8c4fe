"""The real clients connect without a warning, and read our errors as theirs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.sims.airsim.real.environments import CLIENTS
from tests.sims.airsim.real.rig import CAMERA, SENSORS, flown

UNKNOWN = {
    "simGetMeshPositionVertexBuffers",
    "simListSceneObjectsTags",
    "simGetPhysicsRawKinematics",
    "simSetPhysicsRawKinematics",
}
"""Methods that are not there; nobody is known to call them."""

NOT_IN_ITS_WORLD = {"simSpawnObject"}
"""Refused for what is called with."""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # the first one installs its client


@pytest.mark.parametrize("client", CLIENTS)
def test_a_real_client_connects_and_reads_errors(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, drone="") as rig:
        assert rig.script(client, "handshake") == {"ping": True, "vehicles": ["drone"]}
        found = rig.script(client, "errors")
        rig.end()
    unknown, arity, vehicle, sensor, camera, control = found["refused"]
    assert unknown == "rpclib: server could not find function 'simNonsense' with argument count 1."
    assert arity.endswith("with an invalid number of arguments. Expected: 1, got: 0")
    assert "Vehicle API for 'nobody' is not available" in vehicle
    assert "No IMU with name nothing exist on vehicle" in sensor
    assert "nowhere" in camera
    assert "API control" in control or "enableApiControl" in control
    assert all("threw an exception" in each for each in (vehicle, sensor, camera, control))
    assert found["alive"]
    assert "takeoff" in rig.said, "what a future's join hides is logged"


@pytest.mark.parametrize("client", CLIENTS)
def test_every_method_of_a_client_is_answered(client: str, tmp_path: Path) -> None:
    """With as many arguments as it sends; what is refused is so with a reason."""
    with flown(tmp_path, drone=CAMERA + SENSORS) as rig:
        found = rig.script(client, "every_method", limit=300)
        rig.end()
    assert len(found["called"]) > 90
    without_reason = {
        name: error
        for name, error in found["errors"].items()
        if "not supported by visnav-runtime" not in error
    }
    assert without_reason.keys() <= UNKNOWN | NOT_IN_ITS_WORLD, without_reason
