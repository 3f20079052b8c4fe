"""Scripts of the real clients fly: moves, tasks that supersede, several vehicles, resets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.sims.airsim.real.environments import CLIENTS
from tests.sims.airsim.real.rig import flown

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
BOTH = pytest.mark.parametrize("client", CLIENTS)


def fly(client: str, script: str, folder: Path, *, drone: str = "", nodes: str = "") -> Any:
    """Fly a script in real time, and return what it returns."""
    with flown(folder, drone=drone, nodes=nodes) as rig:
        found = rig.script(client, script)
        rig.end()
    return found


@BOTH
def test_the_first_script_of_everybody_flies(client: str, tmp_path: Path) -> None:
    found = fly(client, "hello", tmp_path)
    assert found["start"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    assert found["landed"] == [0, 1, 0]
    assert found["up"] == pytest.approx([0.0, 0.0, -2.0], abs=0.5)
    assert found["there"] == pytest.approx([2.0, 1.0, -2.5], abs=0.5)
    assert found["yaw"] == pytest.approx(90.0, abs=6.0)
    assert found["back"] == pytest.approx([0.0, 0.0, -1.0], abs=0.6)
    assert found["down"][2] == pytest.approx(0.0, abs=0.05)


@BOTH
def test_a_velocity_goes_on_while_the_script_sleeps(client: str, tmp_path: Path) -> None:
    found = fly(client, "unjoined", tmp_path)
    assert found["moving"] > 0.3
    assert found["still"] < 0.1, "it holds its place once the duration is over"
    assert found["distance"] == pytest.approx(1.5, abs=0.6)


@BOTH
def test_a_newer_task_ends_the_older_one(client: str, tmp_path: Path) -> None:
    found = fly(client, "superseded", tmp_path)
    assert (found["far"], found["near"]) == (False, True)
    far, near = found["ended"]
    assert far < 0.3
    assert near > 0.45


@BOTH
def test_two_drones_fly_at_a_time(client: str, tmp_path: Path) -> None:
    other = "[[nodes]]\nname = 'another'\ntype = 'Multirotor'\nposition = [0, 3]\n"
    found = fly(client, "two", tmp_path, nodes=other)
    assert found["names"] == ["another", "drone"]
    assert found["where"]["another"] == pytest.approx([1.0, 0.0, -2.0], abs=0.6)
    assert found["where"]["drone"] == pytest.approx([2.0, 0.0, -2.0], abs=0.6)


@BOTH
def test_a_drone_flies_again_after_a_reset(client: str, tmp_path: Path) -> None:
    found = fly(client, "again", tmp_path)
    assert found["reset"] == pytest.approx([0.0, 0.0, 0.0], abs=0.05)
    assert found["control"] is False
    assert found["up"] == pytest.approx([0.0, 0.0, -2.0], abs=0.5)


@BOTH
def test_a_collision_is_told_once(client: str, tmp_path: Path) -> None:
    found = fly(client, "collision", tmp_path)
    assert not found["before"]
    assert found["has"] == [True, False], "reading it clears it"
    assert found["object"] == "crate"
    assert found["normal"] == pytest.approx([-1.0, 0.0, 0.0], abs=0.2)


@BOTH
def test_clients_of_several_threads_poll_at_a_time(client: str, tmp_path: Path) -> None:
    assert fly(client, "threads", tmp_path) == [20, 20, 20, 20]
