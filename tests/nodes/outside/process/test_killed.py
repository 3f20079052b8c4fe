"""A program that is killed at a random frame ends the run with one error, and loses nothing."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.nodes.outside.process.killing import SIGNALS, kill
from tests.nodes.outside.process.rig import ROOT, STUB
from tests.runtime.ports import free_port

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

RIG = """
[run]
name = "killed"
accept = ["imu-rate", "rates-divide"]

[[nodes]]
name = "drone"
type = "Multirotor"
world = "hall"

[[nodes.cameras]]
name = "camera"
width = 160
height = 120
rate = 20

[nodes.imu]

[[nodes]]
name = "pilot"
type = "WaypointFollower"
waypoints = [[0.0, 0.0, -1.5], [4.4, 0.2, -1.5]]

[[nodes]]
name = "evaluation"
type = "Evaluation"

[[nodes]]
"""


def in_python() -> tuple[str, str, str]:
    """Return node, victim and configuration of a program with the client in Python."""
    client = ROOT / "nodes" / "outside" / "native"
    text = f'name = "slam"\ntype = "Process"\ncommand = ["{sys.executable}", "{STUB}"]\n'
    return "slam", STUB, f'{text}environment = {{ PYTHONPATH = "{client}" }}\n'


def in_cpp() -> tuple[str, str, str]:
    """Return those of the example in C++."""
    if shutil.which("c++") is None:
        pytest.skip("there is no C++ compiler")
    text = (ROOT / "examples" / "outside_cpp.toml").read_text()
    node = text.partition('type = "Process"\n')[2].partition("[[nodes]]")[0]
    node = node.replace('folder = "', f'folder = "{ROOT}/examples/')
    return "slam", "/odometry", f'name = "slam"\ntype = "Process"\n{node}'


def by_ros2() -> tuple[str, str, str]:
    """Return those of the example in ROS 2."""
    pytest.importorskip("zenoh_ros2_sdk")
    text = (ROOT / "examples" / "outside_ros2.toml").read_text()
    _, start, node = text.partition('name = "estimator"')
    node = start + node.partition('[[nodes]]\nname = "evaluation"')[0]
    for here, there in (('"."', f'"{ROOT}/examples"'), ("7447", str(free_port()))):
        node = node.replace(here, there)
    return "estimator", "outside_ros2.py", node


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
@pytest.mark.parametrize("program", [in_python, in_cpp, by_ros2])
def test_a_run_whose_program_is_killed_names_it_and_loses_nothing(
    program: Callable[[], tuple[str, str, str]], number: signal.Signals, tmp_path: Path
) -> None:
    node, victim, text = program()
    kill(RIG + text, victim, node, number, tmp_path / "killed")
