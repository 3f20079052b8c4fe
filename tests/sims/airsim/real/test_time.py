"""Scripts of the real clients step time; what they step is the same every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.sims.airsim.real.environments import CLIENTS
from tests.sims.airsim.real.rig import flown

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.mark.parametrize("client", CLIENTS)
def test_a_script_steps_time(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, drone="") as rig:
        found = rig.script(client, "stepped")
        rig.end()
    steps = np.diff(found["stamps"])
    assert np.all(steps == 250_000_000)
    assert found["paused"]
    assert found["where"][2] == pytest.approx(-2.0, abs=0.5)
    assert found["later"] == found["where"], "nothing moves while time stands"


@pytest.mark.parametrize(("time", "script"), [("paused", "stepped"), ("awaited", "hello")])
def test_equal_scripts_give_equal_runs(time: str, script: str, tmp_path: Path) -> None:
    digests, replies = set(), []
    for number, client in enumerate([*CLIENTS, "airsim"]):
        folder = tmp_path / str(number)
        folder.mkdir()
        settings = f'time = "{time}"'
        with flown(folder, drone="", settings=settings, speed='"max"') as rig:
            replies.append(rig.script(client, script))
            digests.add(rig.end()["digest"])
    assert replies[0] == replies[1] == replies[2]
    assert len(digests) == 1
