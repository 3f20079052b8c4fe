"""Sensors that the real clients read, in AirSim's units and frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.sims.airsim.real.environments import CLIENTS
from tests.sims.airsim.real.rig import SENSORS, flown

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.mark.parametrize("client", CLIENTS)
def test_sensors_are_read(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, drone=SENSORS) as rig:
        found = rig.script(client, "sensors")
        rig.end()
    assert found["imu"] == pytest.approx([0.0, 0.0, -9.807], abs=0.5)
    assert 0 <= found["state_stamp"] - found["imu_stamp"] < 20_000_000
    assert found["pressure"] == pytest.approx(found["environment"], abs=30.0)
    assert 0.2 < np.linalg.norm(found["field"]) < 0.7, "Gauss"
    assert found["fix"] == 3
    assert found["latitude"] == pytest.approx(found["home"], abs=1e-4)
    assert found["distance"] == pytest.approx(3.6, abs=0.3), "to the crate's side"
    assert found["points"] > 200
    assert found["lowest"] < 0.2, "the floor is below"
